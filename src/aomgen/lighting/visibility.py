"""Visibility of light at points past surfaces of any shape, by tracing rays through a grid of cells.

`plane_shadow` is faster for light on a horizontal surface past moving bodies.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_cdt

from aomgen.core.sh import sh_basis, sphere_directions
from aomgen.core.values import Array

# Number of tested directions on the sphere, about ten for each of the nine coefficients of a transfer.
DIRECTIONS: Final = 96
# Number of cells along the longest side of a surface that is represented by dense samples of its meshes.
CELLS: Final = 64
# Number of cells along the longest side of a body that is represented by the less dense centers of its Gaussians.
BODY_CELLS: Final = 32
# Distance above a surface at which rays start, in cells, so that its own cells do not block them.
OFFSET_CELLS: Final = 1.8
# Share of the light on the walls of a cavity that is reflected.
BOUNCE: Final = 0.5


class Occluders:
    """Grid of the cells that contain an occluding surface.

    Args:
        points: Dense points (M, 3) on the surface.
        cells: Number of cells along its longest side.

    Attributes:
        cell: Side of a cell, [m].
    """

    def __init__(self, points: Array, cells: int = CELLS) -> None:
        self._low = points.min(0)
        self.cell = float(np.ptp(points, axis=0).max()) / cells
        shape = np.ceil(np.ptp(points, axis=0) / self.cell).astype(int) + 3
        empty = np.ones(tuple(shape), bool)
        empty[tuple(((points - self._low) / self.cell).astype(int).T + 1)] = False
        # The chessboard distance to the nearest solid cell is the number of cells by which a ray can advance without missing one.
        self._free = np.asarray(distance_transform_cdt(empty, "chessboard"))

    def blocks(self, starts: Array, direction: Array) -> NDArray[np.bool_]:
        """Return the mask (N,) of the rays from `starts` (N, 3) in a direction (3,) that hit a solid cell."""
        # Coordinates are stored as three rows, because operations on three columns are slow.
        position = np.ascontiguousarray(((starts - self._low) / self.cell + 1).T)
        shape, step = np.array(self._free.shape)[:, None], direction[:, None]
        # Rays start at the point at which they enter the grid.
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
    """Compute the mask (N, D) of the directions from which light reaches points; light from behind a surface does not.

    Args:
        points: Points (N, 3) on surfaces.
        normals: Unit normals (N, 3).
        occluders: Occluding surfaces in the same frame.
        directions: Unit directions toward the light (D, 3).
    """
    visible = normals @ directions.T > 0
    starts = points + OFFSET_CELLS * occluders.cell * normals
    for column, direction in zip(visible.T, directions, strict=True):
        column[column] = ~occluders.blocks(starts[column], direction)
    return visible


def estimate_transfer(points: Array, normals: Array, occluders: Occluders) -> tuple[Array, Array]:
    """Estimate the transfer (N, 9), see `core.light`, of points past occluders, and the visible share of the sky (N,).

    The share is weighted by the cosines of the angles to the normal. Blocked light is replaced by light that the occluding
    walls reflect, which is proportional to the visible share of the sky.

    Args:
        points: Points (N, 3) on surfaces.
        normals: Unit normals (N, 3).
        occluders: Occluding surfaces in the same frame.
    """
    directions = sphere_directions(DIRECTIONS)
    visible = find_visibility(points, normals, occluders, directions)
    cosines = np.maximum(normals @ directions.T, 0) * (4 / DIRECTIONS)
    open_share = (cosines * visible).sum(1)
    arriving = np.where(visible, 1, BOUNCE * open_share[:, None])
    return (cosines * arriving) @ sh_basis(directions, 2), open_share


def turn_outward(points: Array, normals: Array, occluders: Occluders) -> Array:
    """Flip normals that point to an enclosed side while the other side is open.

    This is necessary because the triangles of meshes may have either orientation.

    Args:
        points: Points (N, 3) on surfaces.
        normals: Unit normals (N, 3).
        occluders: All surfaces, in the same frame.

    Returns:
        Unit normals (N, 3).
    """
    front, back = (estimate_transfer(points, sign * normals, occluders)[1] for sign in (1.0, -1.0))
    return np.where(((front < 0.1) & (back > 0.3))[:, None], -normals, normals)
