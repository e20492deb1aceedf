"""Visibility of light from points, past surfaces of any shape, by rays through a grid of cells.

`plane_shadow` is the fast path for light that falls on a level surface past moving bodies.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_cdt

from aomgen.core.sh import sh_basis, sphere_directions
from aomgen.core.values import Array

# Number of tested directions on the sphere: about ten for each of the nine coefficients of a transfer.
DIRECTIONS: Final = 96
# Number of cells along the longest side of a surface that is given by dense samples of its meshes.
CELLS: Final = 64
# The same for a body that is given by the centers of its Gaussians alone, which are less dense.
BODY_CELLS: Final = 32
# Rays start this many cells above a surface, or its own cells would block them.
OFFSET_CELLS: Final = 1.8
# Share of the light on the walls of a cavity that they reflect.
BOUNCE: Final = 0.5


class Occluders:
    """Cells that an occluding surface crosses.

    Args:
        points: Dense points (M, 3) on the surface.
        cells: Cells along its longest side.

    Attributes:
        cell: Side of a cell, [m].
    """

    def __init__(self, points: Array, cells: int = CELLS) -> None:
        self._low = points.min(0)
        self.cell = float(np.ptp(points, axis=0).max()) / cells
        shape = np.ceil(np.ptp(points, axis=0) / self.cell).astype(int) + 3
        empty = np.ones(tuple(shape), bool)
        empty[tuple(((points - self._low) / self.cell).astype(int).T + 1)] = False
        # Number of cells to the nearest solid one: a ray can advance as many steps of at most a
        # cell without missing any.
        self._free = np.asarray(distance_transform_cdt(empty, "chessboard"))

    def blocks(self, starts: Array, direction: Array) -> NDArray[np.bool_]:
        """Find which rays from `starts` (N, 3) in a direction (3,) meet a solid cell."""
        # The array has rows of x, y and z: sums over three columns are slow.
        position = np.ascontiguousarray(((starts - self._low) / self.cell + 1).T)
        shape, step = np.array(self._free.shape)[:, None], direction[:, None]
        # Rays start where they enter the box of all cells.
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([-position, shape - position]) / step
        enter, leave = np.nanmax(ends.min(0), 0), np.nanmin(ends.max(0), 0)
        blocked = np.zeros(len(starts), bool)
        going = np.flatnonzero((leave > 0) & (leave > enter))
        position = position[:, going] + np.maximum(enter[going] + 1e-6, 0) * step
        while len(going):
            cells = np.floor(position).astype(np.int64)
            inside = ((cells >= 0) & (cells < shape)).all(0)
            going, position = going[inside], position[:, inside]
            free = self._free[tuple(cells[:, inside])]
            blocked[going[free == 0]] = True
            on = free > 0
            going, position = going[on], position[:, on] + free[on] * step
        return blocked


def find_visibility(
    points: Array, normals: Array, occluders: Occluders, directions: Array
) -> NDArray[np.bool_]:
    """Find whether light from directions (D, 3) reaches points (N, 3) with unit normals (N, 3), as (N, D).

    Light from behind a surface does not reach it.
    """
    visible = normals @ directions.T > 0
    starts = points + OFFSET_CELLS * occluders.cell * normals
    for column, direction in zip(visible.T, directions, strict=True):
        column[column] = ~occluders.blocks(starts[column], direction)
    return visible


def estimate_transfer(points: Array, normals: Array, occluders: Occluders) -> tuple[Array, Array]:
    """Estimate the transfer (N, 9), see `core.light`, of points past occluders, and the open sky share (N,).

    The share is weighted by cosines. Blocked light is replaced by light of the walls that block it; in a
    cavity these are dark in proportion to its closure.
    """
    directions = sphere_directions(DIRECTIONS)
    visible = find_visibility(points, normals, occluders, directions)
    cosines = np.maximum(normals @ directions.T, 0) * (4 / DIRECTIONS)
    open_share = (cosines * visible).sum(1)
    arriving = np.where(visible, 1, BOUNCE * open_share[:, None])
    return (cosines * arriving) @ sh_basis(directions, 2), open_share


def turn_outward(points: Array, normals: Array, occluders: Occluders) -> Array:
    """Flip unit normals (N, 3) whose side is closed in while the other side is open.

    Meshes may be wound either way. `occluders` are all surfaces in the same frame.
    """
    front, back = (estimate_transfer(points, sign * normals, occluders)[1] for sign in (1.0, -1.0))
    return np.where(((front < 0.1) & (back > 0.3))[:, None], -normals, normals)
