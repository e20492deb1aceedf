"""Quadrature of normal distributions."""

import numpy as np
import pytest

from aomgen.core.quadrature import normal_points


def test_means_over_the_points_are_those_of_the_normal_distribution() -> None:
    points = normal_points(500, 3)
    assert points.shape == (500, 3)
    np.testing.assert_allclose(points.mean(0), 0, atol=0.02)
    np.testing.assert_allclose(np.cov(points.T), np.eye(3), atol=0.04)
    assert np.mean(np.cos(points[:, 0])) == pytest.approx(np.exp(-0.5), abs=0.01)


def test_points_are_the_same_at_every_call() -> None:
    np.testing.assert_array_equal(normal_points(20, 2), normal_points(20, 2))
