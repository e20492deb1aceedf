"""What lies inside an object's outline box belongs to the object."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.values import Array

# The box is taken between these quantiles of the object's points, so that strays do not stretch it.
QUANTILES = (0.01, 0.99)
# It is widened by this share of its diagonal, to hold sides that no mask reached.
MARGIN_SHARE = 0.02
# The lowest part of the box is left out: it holds the surface that the object stands on.
FLOOR_SHARE = 0.06


def with_enclosed(
    means_world: ArrayLike, opacities: ArrayLike, labels: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Labels (N,) in which unlabelled Gaussians inside the object's upright box are static.

    Prompts show an object from a few sides; a side that no mask reached would otherwise stay in
    the background when the object is taken away.

    Args:
        means_world: Centres (N, 3), world frame.
        opacities: (N,); only solid Gaussians shape the box.
        labels: (N,) part labels.

    Not checked: another object inside the box becomes part of this one.
    """
    means = np.asarray(means_world, np.float64)
    ours = np.isin(labels, (STATIC, MOVING))
    solid = ours & (np.asarray(opacities) > 0.3)
    R = upright_box_axes(means[solid, :2])
    local = np.column_stack([means[:, :2] @ R, means[:, 2]])
    low, high = np.quantile(local[solid], QUANTILES, axis=0)
    margin = MARGIN_SHARE * float(np.linalg.norm(high - low))
    floor = low[2] + FLOOR_SHARE * (high[2] - low[2])
    inside = np.all((local > low - margin) & (local < high + margin), axis=1) & (local[:, 2] > floor)
    return np.where((labels == BACKGROUND) & inside, STATIC, labels).astype(np.uint8)


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
