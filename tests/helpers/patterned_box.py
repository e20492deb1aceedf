"""A box whose door has a handle, with a wall and a table around it, of patterned Gaussians."""

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate, gaussians_of
from aomgen.core.values import Array

# The handle's middle, and the plane y of the door's face, [m].
HANDLE = np.array([0.45, 0.25, 0.35])
FACE = HANDLE[1] + 0.035


def sheet(corner: list[float], sides: list[list[float]], seed: int) -> Gaussians:
    """A patterned rectangle of round Gaussians, about 7 mm apart."""
    lengths = np.linalg.norm(sides, axis=1)
    counts = np.maximum(np.round(lengths / 0.007).astype(int), 2)
    u, v = (grid.ravel() for grid in np.meshgrid(*((np.arange(n) + 0.5) / n for n in counts), indexing="ij"))
    means = np.array(corner) + np.outer(u, sides[0]) + np.outer(v, sides[1])
    colors = np.random.default_rng(seed).uniform(0.15, 0.85, (40, 40, 3))
    rows, columns = (
        np.clip((share * n / 4).astype(int), 0, 39) for share, n in zip((u, v), counts, strict=True)
    )
    return gaussians_of(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (len(means), 1)),
        scales=np.full((len(means), 3), 0.005),
        opacities=np.full(len(means), 0.95),
        sh=(colors[rows, columns][:, None] - 0.5) / SH_C0,
    )


def bar(middle: Array, half_m: float) -> Gaussians:
    """An upright handle, 12 mm thick."""
    x, y, z = middle - [0.006, 0.006, half_m]
    sides = [([x, y, z], [0.012, 0, 0]), ([x, y + 0.012, z], [0.012, 0, 0])]
    sides += [([x, y, z], [0, 0.012, 0]), ([x + 0.012, y, z], [0, 0.012, 0])]
    return concatenate([sheet(corner, [way, [0, 0, 2 * half_m]], 9) for corner, way in sides])


def scene() -> tuple[Gaussians, NDArray[np.uint8]]:
    """A box, its door with a handle, and a wall and a table around them."""
    x, z, wide, high, deep = 0.42, 0.22, 0.30, 0.26, 0.2
    front = sheet([x, FACE, z], [[wide, 0, 0], [0, 0, high]], 1)
    parts = [front, bar(HANDLE, 0.05)]
    body = [
        sheet([x, FACE + 0.01, z + high], [[wide, 0, 0], [0, deep, 0]], 2),
        sheet([x, FACE + 0.01, z], [[0, deep, 0], [0, 0, high]], 3),
        sheet([x + wide, FACE + 0.01, z], [[0, deep, 0], [0, 0, high]], 4),
        sheet([x, FACE + 0.01, z], [[wide, 0, 0], [0, deep, 0]], 6),
    ]
    around = [
        sheet([-0.2, FACE + 0.3, 0.0], [[1.5, 0, 0], [0, 0, 0.9]], 7),
        sheet([-0.2, -0.1, 0.2], [[1.5, 0, 0], [0, FACE + 0.4, 0]], 8),
    ]
    pieces = [*parts, *body, *around]
    labels = [MOVING] * len(parts) + [STATIC] * len(body) + [BACKGROUND] * len(around)
    return concatenate(pieces), np.repeat(np.array(labels, np.uint8), [len(piece) for piece in pieces])
