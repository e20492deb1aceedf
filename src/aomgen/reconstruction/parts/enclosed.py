"""What lies inside the outline box of an object's body, or of its moving part, belongs to that."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.part_points import SOLID_OPACITY
from aomgen.core.values import Array

# A box is taken between these quantiles of a part's points, so that strays do not stretch it.
QUANTILES = (0.01, 0.99)
# It is widened by this share of its diagonal, to hold sides that no mask reached.
MARGIN_SHARE = 0.02
# The lowest part of the object is left out: there is the surface that it stands on.
FLOOR_SHARE = 0.06


def with_enclosed(
    means_world: ArrayLike, opacities: ArrayLike, labels: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Labels (N,) in which unlabelled Gaussians inside a part's upright box are of that part.

    Prompts show an object from a few sides; a side that no mask reached would otherwise stay in
    the background when the object is taken away, and a handle in the air when its door opens. Each
    part has its own box: around both together there is much air when the object is open. Where the
    boxes share a place it is the body's.

    Args:
        means_world: Centres (N, 3), world frame.
        opacities: (N,); only solid Gaussians shape the boxes.
        labels: (N,) part labels.

    Not checked: another object inside a box becomes part of this one.
    """
    means = np.asarray(means_world, np.float64)
    ours = np.isin(labels, (STATIC, MOVING)) & (np.asarray(opacities) > SOLID_OPACITY)
    bottom, top = np.quantile(means[ours, 2], QUANTILES)
    open_to = (labels == BACKGROUND) & (means[:, 2] > bottom + FLOOR_SHARE * (top - bottom))
    result = labels.copy()
    for part in (MOVING, STATIC):
        members = ours & (labels == part)
        if members.any():
            result[open_to & _enclosed(means, members)] = part
    return result


def _enclosed(means: Array, members: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which points (N, 3) lie in the upright box of some of them (N,)."""
    R = upright_box_axes(means[members, :2])
    local = np.column_stack([means[:, :2] @ R, means[:, 2]])
    low, high = np.quantile(local[members], QUANTILES, axis=0)
    margin = MARGIN_SHARE * float(np.linalg.norm(high - low))
    return np.all((local > low - margin) & (local < high + margin), axis=1)


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
