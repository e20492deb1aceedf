"""Shadows on a surface: against rays, and as laws."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.gaussians import Gaussians, gaussians_of
from aomgen.core.light import light_from_harmonics
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, transform
from aomgen.lighting.object_shadow import FILL, ObjectShadow, tabulate_object_shadow
from aomgen.lighting.plane_shadow import PlaneGrid, project_shadow
from aomgen.twin.binding import with_object
from aomgen.twin.twin import TwinModel
from ray_casting import find_blocked_rays

GRID = PlaneGrid(low=(-0.5, -0.4), cell=0.01, columns=100, rows=80)


@pytest.fixture(scope="module")
def twin(toy_scene) -> TwinModel:
    static, moving = toy_scene.surfels
    T = toy_scene.twin.T_world_object
    return with_object(toy_scene.twin, static, moving, toy_scene.asset.joint, toy_scene.light, T)


@pytest.fixture(scope="module")
def soft(twin) -> ObjectShadow:
    found = tabulate_object_shadow(twin, np.eye(4))
    assert found is not None
    return found


def box() -> Gaussians:
    points = np.random.default_rng(0).uniform((-0.1, -0.1, 0), (0.1, 0.1, 0.2), (20_000, 3))
    return gaussians_of(
        means=points,
        quats=np.tile([1.0, 0, 0, 0], (len(points), 1)),
        scales=np.full((len(points), 3), 0.005),
        opacities=np.full(len(points), 0.9),
        sh=np.zeros((len(points), 1, 3)),
    )


def cells(grid: PlaneGrid) -> np.ndarray:
    x = grid.low[0] + (np.arange(grid.columns) + 0.5) * grid.cell
    y = grid.low[1] + (np.arange(grid.rows) + 0.5) * grid.cell
    return np.stack([*np.meshgrid(x, y), np.zeros((grid.rows, grid.columns))], -1)


def test_a_cast_shadow_is_what_rays_do_not_reach():
    directions = np.array([[0.2, -0.3, 1.0], [0.8, 0.1, 0.5], [0.0, 0.0, 1.0]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    Ts = transform(
        matrix_from_rotvec([[0, 0, 0.3], [0.2, 0, 0], [0, 0, 0.0]]), [[0, 0, 0], [0.1, 0, 0.1], [0, 0, 0]]
    )
    bodies, parts = box(), np.zeros(20_000, np.int32)
    cast = project_shadow(bodies, parts, Ts[:, None], directions, GRID)
    # Gaussians reach 6 mm beyond the box of their centers.
    low, high = np.array([-0.1, -0.1, 0.0]) - 0.006, np.array([0.1, 0.1, 0.2]) + 0.006
    for images, T in zip(cast, Ts, strict=True):
        starts = apply(invert(T), cells(GRID).reshape(-1, 3))
        for image, direction in zip(images, directions @ T[:3, :3], strict=True):
            want = find_blocked_rays(starts, direction, low, high).reshape(image.shape)
            assert np.abs(image - want).mean() < 0.01
            assert ((image > 0.5) != want).mean() < 0.02
            assert want.any()
    np.testing.assert_array_equal(
        cast, project_shadow(bodies, parts, Ts[:, None], directions, GRID, threads=1)
    )


def test_nothing_casts_no_shadow():
    nothing, up = box().select(np.zeros(0, int)), np.array([[0.0, 0.0, 1.0]])
    assert not project_shadow(nothing, None, np.eye(4)[None, None], up, GRID).any()


def test_a_lookup_gives_a_linear_map_back_and_nothing_outside():
    x, y = cells(GRID)[..., 0], cells(GRID)[..., 1]
    places = np.random.default_rng(1).uniform((-0.49, -0.39), (0.49, 0.39), (50, 2))
    found = GRID.lookup(places) @ (2 * x - y).ravel()
    np.testing.assert_allclose(found, 2 * places[:, 0] - places[:, 1], atol=1e-6)
    assert (GRID.lookup(np.array([[9.0, 0.0], [0.0, -9.0]])) @ np.ones(GRID.rows * GRID.columns) == 0).all()


def test_soft_shadow_lies_away_from_the_light_and_fades_out(soft, twin, toy_scene):
    radiance = np.zeros((9, 3))
    radiance[0], radiance[3], radiance[2] = 1.0, -0.6, 0.4  # bright from +x and above
    mirrored = radiance * np.array([1, 1, 1, -1, 1, 1, 1, 1, 1])[:, None]
    share, other = (
        1 - soft.block(light_from_harmonics(sh), twin.T_world_object) for sh in (radiance, mirrored)
    )
    assert share.shape == soft.visibility.shape[1:]
    assert (share >= FILL - 1e-6).all()
    assert (share <= 1 + 1e-6).all()
    assert (share[:, [0, -1]] == 1).all()
    x = apply(twin.T_world_object @ soft.T_object_plane, cells(soft.grid))[..., 0]
    behind = x < np.quantile(x, 0.3)
    assert share[:, behind].mean() < other[:, behind].mean() - 0.01
    assert share[:, x > np.quantile(x, 0.7)].mean() > other[:, x > np.quantile(x, 0.7)].mean() + 0.01


def test_the_table_has_what_the_posed_bodies_let_through(soft, twin):
    rows, grid, state = twin.relit.indices, soft.grid, 3
    solid, door = (
        twin.gaussians.select(rows[twin.relit_bodies == twin.body(name)]) for name in ("object", "part")
    )
    T = invert(soft.T_object_plane)
    directions = soft.directions[::16]
    past_solid, past_door = (
        1 - project_shadow(body, None, pose[None, None], directions, grid)[0]
        for body, pose in ((solid, T), (door, T @ twin.joint.motion(soft.thetas[state])))
    )
    # The maps are made of finer ones.
    assert np.abs(soft.visibility[::16, state] - past_solid * past_door).mean((1, 2)).max() < 0.02


def test_soft_shadow_turns_with_the_object_in_an_even_light(soft, twin):
    turned = transform(matrix_from_rotvec([0, 0, 0.7]), [0.3, -0.1, 0]) @ twin.T_world_object
    even = light_from_harmonics(np.vstack([np.ones((1, 3)), np.zeros((8, 3))]))
    np.testing.assert_allclose(soft.block(even, turned), soft.block(even, twin.T_world_object), atol=1e-6)


def test_a_scaled_object_has_a_scaled_shadow(soft):
    double = soft.scale_by(2.0, prismatic=True)
    assert double.grid.cell == 2 * soft.grid.cell
    np.testing.assert_array_equal(double.thetas, 2 * soft.thetas)
    again = double.scale_by(0.5, prismatic=True)
    np.testing.assert_allclose(again.T_object_plane, soft.T_object_plane, atol=1e-12)
    np.testing.assert_array_equal(soft.scale_by(2.0, prismatic=False).thetas, soft.thetas)


def test_states_interpolate_between_neighbours(soft):
    thetas = np.linspace(soft.thetas[0] - 0.1, soft.thetas[-1] + 0.1, 37)
    found = soft.interpolate(soft.thetas[:, None, None].astype(np.float32), thetas)[:, 0, 0]
    np.testing.assert_allclose(found, np.clip(thetas, soft.thetas[0], soft.thetas[-1]), atol=1e-6)


def test_without_a_lit_object_there_is_no_soft_shadow(twin):
    assert tabulate_object_shadow(replace(twin, relit=None), np.eye(4)) is None
