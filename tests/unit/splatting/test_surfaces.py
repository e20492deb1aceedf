"""What hangs where views look through is told from surfaces, at any scale; it is dropped while training."""

import numpy as np
import pytest
import torch

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.splatting.optimizer import parameters_of, relocate_and_grow
from aomgen.splatting.surfaces import ViewDepth, in_free_space, view_depths
from aomgen.splatting.training import CLEAR_AT, TrainingParams, _clears, _grows

WALL_Z = 4.0


def camera(x: float, scale: float = 1.0) -> Camera:
    T = np.eye(4)
    T[0, 3] = x * scale
    return Camera(fx=300, fy=300, cx=160, cy=120, width=320, height=240, T_world_cam=T)


def views(count: int, scale: float = 1.0, depth: float = WALL_Z) -> list[ViewDepth]:
    cameras = [camera(0.2 * i, scale) for i in range(count)]
    return [ViewDepth(camera=c, depth=np.full((240, 320), depth * scale, np.float32)) for c in cameras]


POINTS = np.array(
    [
        [0.4, 0.0, WALL_Z],  # on the wall
        [0.4, 0.1, 0.985 * WALL_Z],  # less before it than stereo can tell
        [0.4, 0.0, 0.5 * WALL_Z],  # hanging in the room
        [0.4, 0.0, 1.5 * WALL_Z],  # behind the wall
        [40.0, 0.0, 2.0],  # where nobody looks
    ]
)
FREE = [False, False, True, False, False]


@pytest.mark.parametrize("scale", [0.01, 1.0, 50.0])
def test_only_what_hangs_before_a_surface_is_in_free_space(scale):
    assert in_free_space(POINTS * scale, views(5, scale)).tolist() == FREE


def test_one_view_is_not_enough():
    assert not in_free_space(POINTS, views(1)).any()
    assert in_free_space(POINTS, views(2)).tolist() == FREE


def test_views_that_know_nothing_say_nothing():
    assert not in_free_space(POINTS, views(5, depth=float("nan"))).any()


def test_a_thin_thing_that_enough_views_see_as_surface_stays():
    point = POINTS[2:3]
    for on, free in ((0, True), (1, True), (2, False), (5, False)):
        seen = views(5)
        seen = [
            ViewDepth(camera=v.camera, depth=v.depth * (0.5 if i < on else 1)) for i, v in enumerate(seen)
        ]
        assert in_free_space(point, seen).tolist() == [free]


def wall() -> Gaussians:
    """A wall of opaque Gaussians, and one blob that hangs before it, seen through from most sides."""
    x, y = np.meshgrid(np.linspace(-4, 5, 91), np.linspace(-3, 3, 61))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, WALL_Z)], 1)
    means = np.concatenate([means, [[0.4, 0.0, 1.5]]])
    return Gaussians(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (len(means), 1)),
        scales=np.tile([0.06, 0.06, 0.005], (len(means), 1)),
        opacities=np.append(np.full(len(means) - 1, 0.95), 0.2),
        sh=np.zeros((len(means), 1, 3), np.float32),
    )


def test_the_drawn_depth_is_that_of_the_wall():
    seen = view_depths(wall().select(np.arange(91 * 61)), [camera(0.4)], width=160)
    assert seen[0].depth.shape == (120, 160)
    assert np.median(np.abs(seen[0].depth - WALL_Z)) < 0.02


def test_a_faint_blob_before_the_wall_is_found_and_dropped():
    scene = wall()
    free = in_free_space(
        scene.means.astype(np.float64), view_depths(scene, [camera(x) for x in (0, 0.4, 0.8)])
    )
    assert np.flatnonzero(free).tolist() == [len(scene) - 1]
    parameters = parameters_of(scene, 0)
    shares = np.ones(len(scene))
    rng = np.random.default_rng(0)
    kept, _ = relocate_and_grow(parameters, shares, len(scene), 0.01, rng, free)
    assert len(kept) == len(scene)
    assert float(kept.values["means"][:, 2].min()) > 0.9 * WALL_Z
    without, _ = relocate_and_grow(parameters, shares, len(scene), 0.01, np.random.default_rng(0))
    assert float(without.values["means"][:, 2].min()) == pytest.approx(1.5)
    assert torch.isfinite(kept.values["means"]).all()


@pytest.mark.parametrize("iterations", [400, 1200, 3001, 30000])
def test_free_space_is_cleared_once_for_every_share(iterations):
    params = TrainingParams(iterations=iterations)
    cleared = [i for i in range(iterations) if _grows(params, i) and _clears(params, i)]
    assert len(cleared) == len(CLEAR_AT)
    for iteration, share in zip(cleared, CLEAR_AT, strict=True):
        assert 0 <= iteration - share * iterations <= params.grow_every
