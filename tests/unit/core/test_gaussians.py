"""Gaussians from points: widths that follow the spacing, colors that are drawn as given."""

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import gaussians_from_points, neighbour_distances
from aomgen.splatting.rasterizer import render


def grid(spacing: float, count: int = 6) -> np.ndarray:
    axis = spacing * np.arange(count)
    return np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)


def test_spacing_of_a_grid() -> None:
    """Every point of a grid has three neighbours at one step, whatever the unit."""
    for spacing in (1e-3, 1.0, 50.0):
        np.testing.assert_allclose(neighbour_distances(grid(spacing)), spacing)


def test_like_all_pairs() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    pairs = np.linalg.norm(points[:, None] - points, axis=-1)
    want = np.sqrt((np.sort(pairs, 1)[:, 1:4] ** 2).mean(1))
    np.testing.assert_allclose(neighbour_distances(points), np.minimum(want, np.percentile(want, 99)))


def test_two_points() -> None:
    np.testing.assert_allclose(neighbour_distances(np.array([[0, 0, 0], [0, 3.0, 4.0]])), [5, 5])


def test_lonely_and_coinciding_points() -> None:
    points = np.concatenate([grid(0.1), [[1000.0, 0, 0]], np.full((5, 3), 0.25)])
    spacing = neighbour_distances(points)
    assert spacing.max() < 1
    assert spacing.min() > 0


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 3)), np.zeros((1, 3)), np.ones((9, 3)), np.array([[0, 0, 0], [0, np.nan, 0], [1, 1, 1]])],
)
def test_refused(points: np.ndarray) -> None:
    with pytest.raises(ValueError, match="points"):
        gaussians_from_points(points, np.zeros((len(points), 3), np.uint8))


def test_colors_of_other_points() -> None:
    with pytest.raises(ValueError, match="colors"):
        gaussians_from_points(grid(1), np.zeros((3, 3), np.uint8))


def test_drawn_in_their_color() -> None:
    """A dense carpet of one color fills the picture with that color."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1, 1, (4000, 2)), np.zeros((4000, 1))], 1)
    colors = np.tile(np.array([200, 30, 90], np.uint8), (4000, 1))
    gaussians = gaussians_from_points(points, colors, opacity=0.6, size=1.0)
    pose = look_at((0, 0, 1), (0, 0, 0), (0, 1, 0))
    drawn = render(gaussians, Camera(fx=60, fy=60, cx=20, cy=20, width=40, height=40, T_world_cam=pose))
    assert drawn.alpha.mean() > 0.9
    np.testing.assert_allclose(
        drawn.rgb / drawn.alpha[..., None], np.full((40, 40, 3), [200, 30, 90]) / 255, atol=0.01
    )
    assert abs(float(np.median(drawn.depth)) - 1) < 0.05
