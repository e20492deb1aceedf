"""How much of the supporting surface is known and free."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.values import Array

# Cells of the table, [m]: finer than its outline has to be known.
CELL: float = 0.02
# A strip of new cells counts as free table when no run of hidden cells in it is longer than this.
MAX_GAP_CELLS: int = 3


def free_rectangle(
    surface_xy: ArrayLike, low: ArrayLike, high: ArrayLike, reach_m: float = 1.0
) -> tuple[Array, Array]:
    """Grow a rectangle over the surface around an object, until it meets an edge or another object.

    What stands on the surface hides it, so its cells are empty and stop the growth: the rectangle
    is table that is there and has nothing else on it.

    Args:
        surface_xy: Points of the surface (N, 2), seen from above, [m].
        low, high: Corners (2,) of the object's own footprint, taken as free.
        reach_m: Farthest growth on each side, [m].

    Returns:
        Corners (2,) and (2,) of the grown rectangle, axis-aligned, [m].
    """
    xy = np.asarray(surface_xy, np.float64)
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    origin = low - reach_m
    shape = np.ceil((high + reach_m - origin) / CELL).astype(int)
    cells = np.floor((xy - origin) / CELL).astype(int)
    inside = np.all((cells >= 0) & (cells < shape), axis=1)
    free = np.zeros(shape, bool)
    free[tuple(cells[inside].T)] = True
    start = np.floor((low - origin) / CELL).astype(int)
    end = np.ceil((high - origin) / CELL).astype(int)
    free[start[0] : end[0], start[1] : end[1]] = True
    growing = True
    while growing:
        growing = False
        for axis in (0, 1):
            for side in (-1, 1):
                strip = start[axis] - 1 if side < 0 else end[axis]
                if not 0 <= strip < shape[axis]:
                    continue
                across = slice(start[1 - axis], end[1 - axis])
                values = free[strip, across] if axis == 0 else free[across, strip]
                if _longest_gap(values) <= MAX_GAP_CELLS:
                    growing = True
                    if side < 0:
                        start[axis] -= 1
                    else:
                        end[axis] += 1
    return origin + start * CELL, origin + end * CELL


def _longest_gap(free: NDArray[np.bool_]) -> int:
    """Length of the longest run of cells that are not free."""
    edges = np.flatnonzero(np.concatenate([[True], free, [True]]))
    return int(np.diff(edges).max()) - 1
