"""The plane on which the recorded object stands."""

from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import apply, invert, transform
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.errors import ReconstructionError

# Largest height above the plane at which a Gaussian belongs to its surface, [m].
SURFACE: Final = 0.012
# Largest depth below the plane at which a Gaussian belongs to its surface, [m]: trained surfaces include lower Gaussians,
# which are visible through the upper ones.
TAIL: Final = 0.035
# Smallest number of Gaussians from which the plane can be distinguished from outliers.
MIN_SUPPORT: Final = 40
# Lower share of the object's height that determines its footprint, without protruding handles.
LOWER_SHARE: Final = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Support:
    """A nearly horizontal plane with a frame; z = 0 is the surface, and z points up.

    Attributes:
        T_world_plane: Pose of the plane (4, 4); the origin is under the object, and the axes are along its sides.
        low, high: Corners (2,) of the rectangle that the object's lower part covers, plane frame, [m].
        reach_low, reach_high: Corners (2,) of the rectangle that the whole object covers as seen from above, [m].
        top: Height of the object above the plane, [m].
    """

    T_world_plane: Matrix4
    low: Annotated[Array, "2"]
    high: Annotated[Array, "2"]
    reach_low: Annotated[Array, "2"]
    reach_high: Annotated[Array, "2"]
    top: float

    __post_init__ = freeze_arrays

    def coordinates(self, points_world: ArrayLike) -> Array:
        """Transform points (N, 3) to the plane's frame, [m]."""
        return apply(invert(self.T_world_plane), points_world)

    def outside(self, xy: Array) -> Array:
        """Compute the distances (...,) of points (..., 2) on the plane from the lower part's rectangle, 0 inside, [m]."""
        return _distance(xy, self.low, self.high)

    def beyond_reach(self, xy: Array) -> Array:
        """Compute the distances (...,) of points (..., 2) on the plane from the whole object's rectangle, 0 inside, [m]."""
        return _distance(xy, self.reach_low, self.reach_high)


def _distance(xy: Array, low: Array, high: Array) -> Array:
    """Compute the distances (...,) of points (..., 2) from a rectangle, 0 inside."""
    return np.linalg.norm(np.maximum(np.maximum(low - xy, xy - high), 0), axis=-1)


def find_support(body: Gaussians, surroundings: Gaussians, T_world_object: Array) -> Support:
    """Fit the plane under an object.

    Args:
        body: Gaussians of the object, world frame.
        surroundings: Gaussians that belong neither to the object nor to the robot, world frame.
        T_world_object: Pose of the object (4, 4), which determines the directions of the sides.

    Raises:
        ReconstructionError: There is no flat surface around the object's base in the scan.
    """
    solid = body.means[body.opacities > 0.2].astype(np.float64)
    local = apply(invert(T_world_object), solid)
    low, high = np.quantile(local, 0.003, axis=0), np.quantile(local, 0.997, axis=0)
    means = apply(invert(T_world_object), surroundings.means)
    gap = _distance(means[:, :2], low[:2], high[:2])
    near = (
        (surroundings.opacities > 0.3) & (gap < 0.35) & (gap > 0.01) & (np.abs(means[:, 2] - low[2]) < 0.08)
    )
    points = means[near]
    if len(points) >= MIN_SUPPORT:
        # The surface is at the height with the largest product of number and area of the Gaussians: a printed book cover has many
        # small Gaussians, and the layer below the surface has few large ones. The plane is fitted to Gaussians near this height.
        areas = np.sort(surroundings.scales[near], axis=1)[:, 1:].prod(1)
        bins = np.arange(-0.08, 0.0801, 0.004) + low[2]
        counts, edges = np.histogram(points[:, 2], bins=bins)
        covered, _ = np.histogram(points[:, 2], bins=bins, weights=areas)
        level = edges[(counts * covered).argmax()] + 0.002
        points = points[np.abs(points[:, 2] - level) < 0.02]
    plane = np.zeros(3)
    for reach in (0.02, 0.01, 0.006):
        if not len(points) >= MIN_SUPPORT:
            raise ReconstructionError(
                "support", f"{len(points)} Gaussians lie flat around the object, limit {MIN_SUPPORT}",
                "scan the table around the object",
            )  # fmt: skip
        A = np.column_stack([points[:, :2], np.ones(len(points))])
        plane = np.linalg.lstsq(A, points[:, 2], rcond=None)[0]
        points = points[np.abs(points[:, 2] - A @ plane) < reach]
    # The surface is at the most frequent height, which is slightly above the mean of all inliers.
    heights = means[near][:, 2] - np.column_stack([means[near][:, :2], np.ones(near.sum())]) @ plane
    counts, edges = np.histogram(heights, bins=np.arange(-0.012, 0.0121, 0.003))
    plane[2] += edges[counts.argmax()] + 0.0015
    up = np.array([-plane[0], -plane[1], 1.0])
    up /= np.linalg.norm(up)
    x = np.array([1.0, 0, 0]) - up[0] * up
    x /= np.linalg.norm(x)
    T_object_plane = transform(np.stack([x, np.cross(up, x), up], 1), np.array([0, 0, plane[2]]))
    inside = apply(invert(T_object_plane), local)
    top = float(np.quantile(inside[:, 2], 0.997))
    lower = inside[inside[:, 2] < max(LOWER_SHARE * top, 0.04)]
    lower = lower if len(lower) >= MIN_SUPPORT else inside
    return Support(
        T_world_plane=T_world_object @ T_object_plane,
        low=np.quantile(lower, 0.005, axis=0)[:2],
        high=np.quantile(lower, 0.995, axis=0)[:2],
        reach_low=np.quantile(inside, 0.003, axis=0)[:2],
        reach_high=np.quantile(inside, 0.997, axis=0)[:2],
        top=top,
    )


def on_surface(gaussians: Gaussians, support: Support) -> NDArray[np.bool_]:
    """Return the mask (N,) of the Gaussians on the plane."""
    heights = support.coordinates(gaussians.means)[:, 2]
    return (heights > -TAIL) & (heights < SURFACE)
