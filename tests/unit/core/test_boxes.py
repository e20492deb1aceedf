"""Oriented boxes around points."""

import numpy as np
import pytest

from aomgen.core.boxes import OrientedBox, find_upright_axes, fit_box, upright_axes
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.errors import InputError

SIZE = np.array([0.6, 0.2, 0.4])


def points_of(R: np.ndarray, count: int = 2000) -> np.ndarray:
    return np.random.default_rng(0).uniform(-SIZE / 2, SIZE / 2, (count, 3)) @ R.T + [1.0, -2.0, 0.5]


@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.2])
def test_the_upright_box_follows_the_points(yaw):
    points = points_of(upright_axes(yaw))
    axis = find_upright_axes(points)[:, 0]
    angle = np.degrees(np.arctan2(axis[1], axis[0])) - np.degrees(yaw)
    assert abs((angle + 45) % 90 - 45) < 2
    assert find_upright_axes(points)[:, 2] == pytest.approx([0, 0, 1])


def test_a_box_has_twelve_edges_of_three_directions():
    box = fit_box(points_of(np.eye(3)), np.eye(3))
    assert box.edges().shape == (12, 2, 3)
    assert len(np.unique(np.round(box.edges().mean(1), 6), axis=0)) == 12
    assert 2 * box.half_extents == pytest.approx(SIZE, abs=0.02)


def test_faces_hold_the_corners_and_part_inside_from_outside():
    R = matrix_from_rotvec([0.3, -0.5, 0.9])
    box = OrientedBox(T_world_box=transform(R, [1.0, 2, 3]), half_extents=SIZE / 2)
    points = points_of(R)[:, None] * 1.0 - [1.0, -2.0, 0.5] + [1.0, 2, 3]
    inside = np.concatenate(points)
    low, high = box.faces()[:2]
    for points, is_inside in ((inside, True), (inside + 2 * R[:, 0], False)):
        assert (((points @ low[0] > low[1]) & (points @ high[0] < high[1])) == is_inside).all()
    for normal, offset in box.faces():
        assert np.sum(np.isclose(box.corners() @ normal, offset)) == 4


def test_too_few_points_are_refused():
    with pytest.raises(InputError, match="need 20"):
        fit_box(np.zeros((5, 3)), np.eye(3))
