from dataclasses import replace

import numpy as np
import pytest

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.camera import Camera, look_at
from aomgen.core.transforms import apply, rotvec_from_matrix, similarity_parts
from benchmarks.motion_scan import Surface, displaced
from benchmarks.motion_upstream import SolidStatistics, Upstream, draw_misplacement, mislabelled

MIDDLE = np.array([0.6, 0.1, 0.2])


@pytest.fixture
def camera() -> Camera:
    pose = look_at(MIDDLE + np.array([-0.9, -0.5, 0.6]), MIDDLE)
    return Camera(fx=320, fy=320, cx=160, cy=120, width=320, height=240, T_world_cam=pose)


def board(spacing: float = 0.005) -> Surface:
    """A door, 0.3 m wide, in the middle of a front, 0.6 m wide, seen from -y."""
    x, z = np.meshgrid(np.arange(-0.3, 0.3, spacing), np.arange(0.0, 0.3, spacing))
    points = np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()])
    return Surface(
        points=points,
        normals=np.tile([0.0, -1.0, 0.0], (len(points), 1)),
        colors_srgb=np.full((len(points), 3), 0.5),
        labels=np.where(np.abs(points[:, 0]) < 0.15, MOVING, STATIC).astype(np.uint8),
    )


def test_scene_and_camera_are_off_by_the_stated_amounts(camera):
    upstream, rng = Upstream(), np.random.default_rng(0)
    turns, scales, shifts, places, pixels, clocks = [], [], [], [], [], []
    for _ in range(400):
        off = draw_misplacement(upstream, camera, MIDDLE, rng)
        scale, R, _ = similarity_parts(off.S_given_world)
        turns.append(np.degrees(rotvec_from_matrix(R)))
        scales.append(100 * (scale - 1))
        shifts.append(1e3 * (apply(off.S_given_world, MIDDLE) - MIDDLE))
        # What is wrong of the camera alone shows in the scene's own frame.
        center = apply(np.linalg.inv(off.S_given_world), off.camera.center)
        places.append(1e3 * (center - camera.center))
        given = off.camera.project(apply(off.S_given_world, MIDDLE)[None])[0][0]
        pixels.append(given - camera.project(MIDDLE[None])[0][0])
        clocks.append(1e3 * off.clock_s)
    for values, wanted in (
        (turns, upstream.rotation_deg),
        (scales, upstream.scale_pct),
        (shifts, upstream.shift_mm),
        (places, upstream.camera_mm),
        (pixels, upstream.camera_px),
        (clocks, upstream.clock_ms),
    ):
        assert np.std(values) == pytest.approx(wanted, rel=0.1)
        assert abs(np.mean(values)) < 0.2 * wanted


def test_offsets_follow_the_measured_table():
    walls = Upstream().walls
    assert 1e3 * walls.offsets_m(np.zeros(1))[0] == pytest.approx(-2.4)
    assert 1e3 * walls.offsets_m(np.array([1.6449]))[0] == pytest.approx(9.5, abs=0.01)
    assert SolidStatistics(offsets_mm=(-1.0,) * 8).offsets_m(np.array([-9.0, 9.0])).tolist() == [-1e-3, -1e-3]


def test_a_wall_is_moved_inward_in_patches():
    surface = board(0.004)
    upstream = replace(Upstream(), floaters=0.0)
    moved = displaced(surface, upstream, np.random.default_rng(1))
    offsets = 1e3 * (surface.points - moved)[:, 1]
    assert np.median(offsets) == pytest.approx(-2.4, abs=0.3)
    assert np.percentile(offsets, 5) == pytest.approx(-8.0, abs=1.2)
    grid = offsets.reshape(75, 150)

    def alike(step: int) -> float:
        return float(np.corrcoef(grid[:, step:].ravel(), grid[:, :-step].ravel())[0, 1])

    assert 0.15 < alike(1) < 0.6
    assert abs(alike(8)) < 0.1


def test_floaters_stand_before_the_surface():
    surface = board(0.004)
    still = SolidStatistics(offsets_mm=(0.0,) * 8)
    upstream = replace(Upstream(), walls=still, bars=still, floaters=0.2, floaters_mm=10.0)
    heights = -1e3 * displaced(surface, upstream, np.random.default_rng(2))[:, 1]
    assert np.mean(heights > 0) == pytest.approx(0.2, abs=0.02)
    assert np.mean(heights[heights > 0]) == pytest.approx(10.0, rel=0.1)


def test_labels_are_wrong_along_the_border_and_hardly_inside():
    surface, rng = board(), np.random.default_rng(3)
    upstream = replace(Upstream(), strip_share=0.0)
    away = np.abs(np.abs(surface.points[:, 0]) - 0.15)
    wrong = [mislabelled(surface.points, surface.labels, upstream, rng) != surface.labels for _ in range(30)]
    rates = np.mean(wrong, axis=0)
    assert 0.15 < rates[away < 0.01].mean() < 0.5
    assert rates[away > 0.06].mean() < 0.06


def test_true_labels_stay_where_nothing_is_wrong():
    surface = board()
    exact = replace(Upstream(), border_mm=0.0, border_local_mm=0.0, strip_share=0.0, strangers=0.0)
    found = mislabelled(surface.points, surface.labels, exact, np.random.default_rng(4))
    assert np.array_equal(found, surface.labels)


def test_lost_labels_go_to_the_background_at_the_stated_share():
    surface, rng = board(), np.random.default_rng(5)
    upstream = replace(Upstream(), strangers=0.02)
    shares = [
        np.mean(mislabelled(surface.points, surface.labels, upstream, rng) == BACKGROUND) for _ in range(60)
    ]
    assert np.mean(shares) == pytest.approx(0.02, rel=0.5)
