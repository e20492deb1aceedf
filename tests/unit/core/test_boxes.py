"""Upright boxes around points."""

import numpy as np
import pytest

from aomgen.core.boxes import upright_box_axes


@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.2])
def test_the_rectangle_follows_the_points(yaw):
    points = np.random.default_rng(0).uniform([-0.3, -0.1], [0.3, 0.1], (2000, 2))
    R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    axis = upright_box_axes(points @ R.T)[:, 0]
    angle = np.degrees(np.arctan2(axis[1], axis[0])) - np.degrees(yaw)
    assert abs((angle + 45) % 90 - 45) < 2
