"""How much of the sky a surface point sees past its own link, as transfer coefficients."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.sh import sh_basis
from aomgen.core.values import Array

# Directions on the sphere that are tested: many for each of the nine coefficients.
DIRECTIONS: Final = 96
# Cells along the longest side of the occluding surface.
CELLS: Final = 64
# Light that comes back from the walls of a cavity, as a share of what they block.
BOUNCE: Final = 0.25


def sphere_directions(count: int) -> Array:
    """Evenly spread unit directions (count, 3): a golden spiral."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + np.sqrt(5)) * k
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)


def estimate_transfer(points: Array, normals: Array, surface: Array) -> tuple[NDArray[np.float32], Array]:
    """Transfer (N, 9) of points among the surface's own occlusion, and their unit normals (N, 3).

    A normal whose side is closed in while the other side is open is turned round: meshes may
    be wound either way. `surface` has dense points (M, 3) on everything that occludes, same frame.
    """
    low = surface.min(0)
    cell = float(np.ptp(surface, axis=0).max()) / CELLS
    shape = np.ceil(np.ptp(surface, axis=0) / cell).astype(int) + 3
    solid = np.zeros(tuple(shape), bool)
    solid[tuple(((surface - low) / cell).astype(int).T + 1)] = True
    directions = sphere_directions(DIRECTIONS)
    basis = sh_basis(directions, 2)
    sides = []
    for sign in (1.0, -1.0):
        transfer = np.zeros((len(points), 9))
        seen = np.zeros(len(points))
        for direction, values in zip(directions, basis, strict=True):
            cosine = sign * normals @ direction
            facing = np.flatnonzero(cosine > 0)
            start = points[facing] + 1.8 * cell * sign * normals[facing]
            open_ = ~_blocked(start, direction, solid, low, cell)
            weight = cosine[facing] * np.where(open_, 1.0, BOUNCE) * 4 / DIRECTIONS
            transfer[facing] += weight[:, None] * values
            seen[facing] += open_ * cosine[facing] * 4 / DIRECTIONS
        sides.append((transfer, seen))
    turned = (sides[0][1] < 0.1) & (sides[1][1] > 0.3)
    transfer = np.where(turned[:, None], sides[1][0], sides[0][0])
    return transfer.astype(np.float32), np.where(turned[:, None], -normals, normals)


def _blocked(
    start: Array, direction: Array, solid: NDArray[np.bool_], low: Array, cell: float
) -> NDArray[np.bool_]:
    """Which rays from `start` (N, 3) meet a solid cell."""
    position = (start - low) / cell + 1
    blocked = np.zeros(len(start), bool)
    going = np.arange(len(start))
    limits = np.array(solid.shape)
    while len(going):
        cells = position[going].astype(np.int64)
        inside = ((position[going] >= 0) & (cells < limits)).all(1)
        going, cells = going[inside], cells[inside]
        hit = solid[cells[:, 0], cells[:, 1], cells[:, 2]]
        blocked[going[hit]] = True
        going = going[~hit]
        position[going] += direction
    return blocked
