"""Distances and overlaps of oriented boxes."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.values import Array


def boxes_overlap(
    Ts_a: ArrayLike, half_a: ArrayLike, Ts_b: ArrayLike, half_b: ArrayLike, *, margin: float = 0.0
) -> NDArray[np.bool_]:
    """Whether pairs of oriented boxes come closer than `margin`.

    Args:
        Ts_a, Ts_b: Poses of the centres (..., 4, 4) in one frame, broadcast against each other.
        half_a, half_b: Half extents (..., 3), [m].
        margin: Boxes grown by this count as overlapping, [m]; negative values forgive contact.

    Returns:
        (...,) bool.

    Source: Gottschalk, Lin, Manocha, "OBBTree", 1996 (15 separating axes).
    """
    Ts_a, Ts_b = np.asarray(Ts_a, np.float64), np.asarray(Ts_b, np.float64)
    half_a = np.asarray(half_a, np.float64) + margin
    half_b = np.asarray(half_b, np.float64)
    R = np.swapaxes(Ts_a[..., :3, :3], -1, -2) @ Ts_b[..., :3, :3]
    offset = np.einsum("...ji,...j->...i", Ts_a[..., :3, :3], Ts_b[..., :3, 3] - Ts_a[..., :3, 3])
    # Parallel edges give no axis of their own; the small term keeps them from separating by round-off.
    size = np.abs(R) + 1e-9
    separated = np.any(np.abs(offset) > half_a + np.einsum("...ij,...j->...i", size, half_b), -1)
    along_b = np.einsum("...ij,...i->...j", R, offset)
    separated |= np.any(np.abs(along_b) > half_b + np.einsum("...ij,...i->...j", size, half_a), -1)
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            reach_a = half_a[..., i1] * size[..., i2, j] + half_a[..., i2] * size[..., i1, j]
            reach_b = half_b[..., j1] * size[..., i, j2] + half_b[..., j2] * size[..., i, j1]
            distance = np.abs(offset[..., i2] * R[..., i1, j] - offset[..., i1] * R[..., i2, j])
            separated |= distance > reach_a + reach_b
    return ~separated


def distance_to_boxes(points: ArrayLike, Ts: ArrayLike, half_extents: ArrayLike) -> Array:
    """Distances (P, B) of points (P, 3) to oriented boxes, 0 inside, [m].

    Args:
        Ts: Poses of the centres (B, 4, 4).
        half_extents: (B, 3), [m].
    """
    Ts = np.asarray(Ts, np.float64)
    relative = np.asarray(points, np.float64)[:, None, :] - Ts[None, :, :3, 3]
    local = np.einsum("bji,pbj->pbi", Ts[:, :3, :3], relative)
    return np.linalg.norm(np.maximum(np.abs(local) - np.asarray(half_extents), 0.0), axis=-1)
