"""The table as physics sees it: a rectangle of it that is there and has nothing on it."""

from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_closing

from aomgen.core.demonstration import SupportPlane
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.replacement.removal import Cleared
from aomgen.twin.plan_view import PlanView

# How far around the object the table is looked for, and free table grows, [m].
TABLE_REACH_M = 1.0
# Cell of the image in which the table is found, and of the grid on which free table grows, [m]: finer than its
# outline has to be known.
TABLE_CELL_M, FREE_CELL_M = 0.01, 0.02
# A cell with less accumulated alpha than this was not seen.
SURFACE_ALPHA = 0.15
# Holes of this many cells between Gaussians are closed, and a strip of cells counts as free table when no run of
# hidden ones in it is longer.
GAP_CELLS = 3


def support_plane(cleared: Cleared) -> SupportPlane:
    """Height of the cleared scene's table, and the rectangle about the old object that is there and free."""
    support = cleared.support
    low, high = support.low - TABLE_REACH_M, support.high + TABLE_REACH_M
    plan = PlanView(support=support, low=low, high=high, cell=TABLE_CELL_M)
    world = cleared.twin.gaussians.select(cleared.twin.bodies == 0)
    xy = plan.xy[binary_closing(plan.cover(world) > SURFACE_ALPHA, iterations=GAP_CELLS)]
    xy_corners = [
        [x, y] for x in (support.low[0], support.high[0]) for y in (support.low[1], support.high[1])
    ]

    def in_world(plane_xy: Array) -> Array:
        return apply(support.T_world_plane, np.column_stack([plane_xy, np.zeros(len(plane_xy))]))[:, :2]

    footprint = in_world(np.array(xy_corners))
    free_low, free_high = free_rectangle(in_world(xy), footprint.min(0), footprint.max(0))
    return SupportPlane(height=float(support.T_world_plane[2, 3]), low_xy=free_low, high_xy=free_high)


def free_rectangle(surface_xy: ArrayLike, low: ArrayLike, high: ArrayLike) -> tuple[Array, Array]:
    """Grow a rectangle over the surface around an object, until it meets an edge or another object.

    What stands on the surface hides it, so its cells are empty and stop the growth: the rectangle
    is table that is there and has nothing else on it.

    Args:
        surface_xy: Points of the surface (N, 2), seen from above, [m].
        low, high: Corners (2,) of the object's own footprint, taken as free.
    """
    xy = np.asarray(surface_xy, np.float64)
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    origin = low - TABLE_REACH_M
    shape = np.ceil((high + TABLE_REACH_M - origin) / FREE_CELL_M).astype(int)
    cells = np.floor((xy - origin) / FREE_CELL_M).astype(int)
    inside = np.all((cells >= 0) & (cells < shape), axis=1)
    free = np.zeros(shape, bool)
    free[tuple(cells[inside].T)] = True
    start = np.floor((low - origin) / FREE_CELL_M).astype(int)
    end = np.ceil((high - origin) / FREE_CELL_M).astype(int)
    free[start[0] : end[0], start[1] : end[1]] = True
    growing = True
    while growing:
        growing = False
        for axis, (ends, step) in product((0, 1), ((start, -1), (end, 1))):
            strip = ends[axis] - 1 if step < 0 else ends[axis]
            across = slice(start[1 - axis], end[1 - axis])
            if 0 <= strip < shape[axis] and _longest_gap(free.take(strip, axis)[across]) <= GAP_CELLS:
                ends[axis] += step
                growing = True
    return origin + start * FREE_CELL_M, origin + end * FREE_CELL_M


def _longest_gap(free: NDArray[np.bool_]) -> int:
    """Length of the longest run of cells that are not free."""
    edges = np.flatnonzero(np.concatenate([[True], free, [True]]))
    return int(np.diff(edges).max()) - 1
