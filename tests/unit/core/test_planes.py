"""Planes among points."""

import numpy as np
import pytest

from aomgen.core.planes import find_plane, fit_plane


def table_and_wall(rng: np.random.Generator) -> np.ndarray:
    table = np.column_stack([rng.uniform(-1, 1, (600, 2)), rng.normal(0.3, 0.002, 600)])
    wall = np.column_stack([rng.normal(1.0, 0.002, 900), rng.uniform(-1, 1, (900, 2))])
    return np.concatenate([table, wall, rng.uniform(-1, 1, (300, 3))])


def test_the_largest_plane_is_found_and_one_of_a_direction():
    rng = np.random.default_rng(0)
    points = table_and_wall(rng)
    wall, members = find_plane(points, 0.01, rng)
    assert abs(wall.normal[0]) == pytest.approx(1, abs=1e-4)
    assert members[600:1500].mean() > 0.99
    table, members = find_plane(points, 0.01, rng, np.array([0.1, 0.0, 1.0]))
    assert abs(table.heights(np.array([[0.0, 0.0, 0.3]]))[0]) < 1e-3
    assert members[:600].mean() > 0.99


def test_triples_that_hold_a_point_twice_are_no_planes():
    """Of few points most triples do; each would be near every point."""
    rng = np.random.default_rng(1)
    points = np.concatenate(
        [np.column_stack([rng.uniform(-1, 1, (6, 2)), np.zeros(6)]), [[0, 0, 5], [1, 2, 9]]]
    )
    plane, members = find_plane(points, 0.01, rng)
    assert abs(plane.normal[2]) == pytest.approx(1)
    assert members.tolist() == [True] * 6 + [False] * 2


def test_points_without_a_plane_of_the_direction_have_no_members():
    flat = np.column_stack([np.random.default_rng(2).uniform(-1, 1, (50, 2)), np.zeros(50)])
    _, members = find_plane(flat, 0.01, np.random.default_rng(2), np.array([1.0, 0, 0]))
    assert not members.any()


def test_least_squares_through_points():
    points = np.column_stack([np.random.default_rng(3).uniform(-1, 1, (50, 2)), np.full(50, 0.7)])
    assert abs(fit_plane(points).offset) == pytest.approx(0.7)
