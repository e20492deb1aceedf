"""Boxes and their edges."""

import numpy as np
import pytest

from aomgen.errors import InputError
from aomgen.motion.edges import footprint_yaw, upright_box

YAW = 0.4
R = np.array([[np.cos(YAW), -np.sin(YAW), 0], [np.sin(YAW), np.cos(YAW), 0], [0, 0, 1.0]])


def box_points(low: tuple, high: tuple, seed: int = 0, count: int = 3000) -> np.ndarray:
    """Points on the surface of a box that is turned by YAW."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(low, high, (count, 3))
    faces = rng.integers(0, 6, count)
    points[np.arange(count), faces % 3] = np.where(
        faces < 3, np.array(low)[faces % 3], np.array(high)[faces % 3]
    )
    return points @ R.T


# A microwave in its own frame: front towards -y, door hinged at x = -0.22.
BODY = box_points((-0.22, -0.14, 0), (0.22, 0.2, 0.26))
DOOR = box_points((-0.22, -0.17, 0.01), (0.22, -0.145, 0.25), 1)


def test_a_box_has_twelve_edges_of_three_directions() -> None:
    box = upright_box(BODY, footprint_yaw(BODY))
    edges = box.edges()
    assert edges.shape == (12, 2, 3)
    assert len(np.unique(np.round(edges.mean(1), 6), axis=0)) == 12
    assert 2 * np.sort(box.half_extents) == pytest.approx([0.26, 0.34, 0.44], abs=0.01)


def test_the_yaw_of_a_turned_box_is_found() -> None:
    assert footprint_yaw(BODY) == pytest.approx(YAW, abs=np.radians(1))


def test_too_few_points_are_refused() -> None:
    with pytest.raises(InputError, match="need 20"):
        upright_box(DOOR[:5], 0.0)
