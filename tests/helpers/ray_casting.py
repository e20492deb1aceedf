"""Visibility past a box by brute force."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def find_blocked_rays(points: ArrayLike, direction: ArrayLike, low: ArrayLike, high: ArrayLike) -> NDArray:
    """Mark the rays (N,) from points (N, 3) in a direction (3,) that meet the box between two corners (3,)."""
    starts, way = np.asarray(points, float), np.asarray(direction, float)
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    to_low, to_high = (np.asarray(low) - starts) / way, (np.asarray(high) - starts) / way
    enter, leave = np.minimum(to_low, to_high).max(-1), np.maximum(to_low, to_high).min(-1)
    return leave > np.maximum(enter, 0)
