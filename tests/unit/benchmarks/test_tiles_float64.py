"""The float64 tiles are the rasterizer as the parity tests' plain reference means it."""

import dataclasses

import numpy as np
import pytest
import torch

import splatting_reference as plain
from aomgen.core import sh
from benchmarks.projection import PARAMETERS, parameters_of, sh_basis
from benchmarks.scenes import table_camera, table_top
from benchmarks.tiles_float64 import TileReference, choose_tiles, tile_mask


@pytest.fixture
def scene():
    """A scene of large splats on an image that is no multiple of a tile, and a loss's gradient."""
    camera = table_camera(70, 50)
    parameters = parameters_of(table_top(250, 3))
    parameters["log_scales"] = parameters["log_scales"] + 1
    grad_planes = torch.tensor(np.random.default_rng(0).normal(size=(5, 50, 70)))
    return parameters, camera, grad_planes


def plain_planes(parameters, camera):
    rgb, depth, alpha = plain.render(parameters, camera, 3, (0.0, 0.0, 0.0))
    return torch.cat([rgb, depth[None], alpha[None]])


def test_pictures_and_gradients_are_those_of_the_plain_reference(scene):
    parameters, camera, grad_planes = scene
    leaves = {name: tensor.double().requires_grad_() for name, tensor in parameters.items()}
    planes = plain_planes(leaves, camera)
    tiles = choose_tiles(camera, 6, seed=1)
    mask = torch.tensor(tile_mask(camera, tiles))
    (planes * grad_planes * mask).sum().backward()
    reference = TileReference(parameters, camera, 3, tiles)
    drawn = reference.images().planes
    assert 0 < mask.sum() < mask.numel()
    assert (planes.detach() * mask - drawn).abs().max() < 1e-13
    gradients = reference.gradients(grad_planes)
    for name in PARAMETERS:
        want = leaves[name].grad
        assert want is not None
        assert want.abs().max() > 0
        assert (gradients[name] - want).abs().max() < 1e-11 * want.abs().max(), name


def test_the_same_gradients_come_out_twice(scene):
    parameters, camera, grad_planes = scene
    reference = TileReference(parameters, camera, 1, choose_tiles(camera, 2, seed=0))
    first, second = reference.gradients(grad_planes), reference.gradients(grad_planes)
    assert all(torch.equal(first[name], second[name]) for name in PARAMETERS)


def test_blended_pairs_are_those_with_weight(scene):
    parameters, camera, _ = scene
    exact = {name: tensor.double() for name, tensor in parameters.items()}
    _, weights, _, _ = plain.blend_weights(exact, camera, 3)
    images = TileReference(parameters, camera, 3, choose_tiles(camera, 100, seed=0)).images()
    assert images.blended == int((weights > 0).sum())


def test_a_splat_at_the_limit_leaves_pixels_undecided():
    """One splat whose alpha is 1/255 at its centre, on a pixel's centre."""
    camera = dataclasses.replace(table_camera(32, 32), cx=16.5, cy=16.5)
    parameters = parameters_of(table_top(1, 0))
    parameters["means"] = torch.tensor([[0.0, 0.0, 0.1]])  # what the camera looks at
    decided = []
    for alpha in (0.9, 1 / 255 + 1e-7):
        parameters["logit_opacities"] = torch.tensor([np.log(alpha / (1 - alpha))])
        images = TileReference(parameters, camera, 0, choose_tiles(camera, 4, seed=0)).images()
        decided.append(bool(images.decided[16, 16]))
    assert decided == [True, False]


def test_splats_at_one_depth_leave_pixels_undecided(scene):
    parameters, camera, _ = scene
    doubled = {name: torch.cat([tensor, tensor]) for name, tensor in parameters.items()}
    tiles = choose_tiles(camera, 100, seed=0)
    alone = TileReference(parameters, camera, 0, tiles).images().decided.double().mean()
    together = TileReference(doubled, camera, 0, tiles).images().decided.double().mean()
    assert alone > 0.8
    assert together < 0.1


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_by_recurrence_are_the_expanded_ones(degree):
    directions = np.random.default_rng(degree).normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    have = sh_basis(torch.tensor(directions), degree).numpy()
    np.testing.assert_allclose(have, sh.sh_basis(directions, degree), atol=1e-14)
