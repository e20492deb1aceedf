"""The torch rasterizer that the engine is compared with draws the same picture."""

import numpy as np
import pytest
import torch

from benchmarks.projection import PARAMETERS, parameters_of
from benchmarks.scenes import table_camera, table_top
from benchmarks.tiles_float64 import TileReference, choose_tiles
from benchmarks.torch_tiles import render


@pytest.mark.parametrize("tile_px", [16, 32])
def test_it_agrees_with_float64(tile_px):
    camera, parameters = table_camera(70, 50), parameters_of(table_top(2000, 3))
    reference = TileReference(parameters, camera, 3, choose_tiles(camera, 100, seed=0))
    images = reference.images()
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in parameters.items()}
    planes = render(leaves, camera, 3, tile_px=tile_px)
    noise = np.random.default_rng(0).normal(size=planes.shape)
    grad_planes = torch.tensor(noise) * images.decided
    planes.backward(grad_planes.float())
    want = reference.gradients(grad_planes)
    assert images.decided.double().mean() > 0.9
    assert (planes.detach() - images.planes)[:, images.decided].abs().max() < 5e-5
    for name in PARAMETERS:
        have = leaves[name].grad
        assert have is not None
        assert (have - want[name]).abs().max() < 1e-4 * want[name].abs().max(), name
