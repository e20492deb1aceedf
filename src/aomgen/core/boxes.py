"""Upright boxes around points."""

import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.values import Array

# A box lies between these quantiles of the points, so that strays do not stretch it.
QUANTILES = (0.01, 0.99)


def upright_box_axes(points_xy: ArrayLike) -> Array:
    """Axes (2, 2), as columns, of the level rectangle of least area around points (N, 2)."""
    xy = np.asarray(points_xy, np.float64)
    best, best_area = np.eye(2), np.inf
    for yaw in np.radians(np.arange(0.0, 90.0)):
        R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        low, high = np.quantile(xy @ R, QUANTILES, axis=0)
        area = float(np.prod(high - low))
        if area < best_area:
            best, best_area = R, area
    return best
