"""Labels of Gaussians made whole: pieces that hang together, neighbors for those nobody saw."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label as connected
from scipy.spatial import cKDTree

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.values import Array

# Size of the grid on which pieces of a part must touch.
VOXEL_M = 0.02
# Painted weight below which no view has really seen a Gaussian, [px].
MIN_WEIGHT = 0.02


def settled(
    points: NDArray[np.float32], votes: Array, open_to: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Labels and confidence (N,) from votes: unseen points follow their neighbors, parts are one piece.

    Args:
        points: (N, 3), world frame, [m].
        votes: (N, 3), weight of background, static and moving part.
        open_to: (N,), which may belong to the object.
    """
    values = np.array([BACKGROUND, STATIC, MOVING], np.uint8)
    seen = votes.sum(1)
    winner = values[np.argmax(votes, 1)]
    confidence = votes.max(1) / np.maximum(seen, 1e-9)
    known = (seen > MIN_WEIGHT) & open_to
    winner[~known], confidence[~known] = BACKGROUND, 0.0
    winner = fill_unseen(points, winner, known, open_to, VOXEL_M)
    result = np.zeros(len(points), np.uint8)
    for value, column in ((STATIC, 1), (MOVING, 2)):
        result[largest_piece(points, winner == value, votes[:, column] + 1e-6, VOXEL_M)] = value
    return result, confidence.astype(np.float32)


def fill_unseen(
    points: NDArray[np.float32],
    labels: NDArray[np.uint8],
    known: NDArray[np.bool_],
    open_to: NDArray[np.bool_],
    voxel_m: float,
) -> NDArray[np.uint8]:
    """Points that no asked view shows take the label of their nearest neighbors.

    Args:
        points: (N, 3), world frame, [m].
        labels: (N,), see `conventions.PART_LABELS`.
        known: (N,), whose labels count.
        open_to: (N,), which may be filled.
        voxel_m: Neighbors farther than one and a half of it mean background.
    """
    unseen = np.flatnonzero(~known & open_to)
    if not len(unseen) or known.sum() < 8:
        return labels
    distances, nearest = cKDTree(points[known]).query(points[unseen], k=8)
    around = labels[known][nearest]
    counts = np.stack([(around == value).sum(1) for value in range(4)], 1)
    filled = labels.copy()
    filled[unseen] = np.where(np.median(distances, 1) < 1.5 * voxel_m, np.argmax(counts, 1), BACKGROUND)
    return filled


def largest_piece(
    points: NDArray[np.float32], which: NDArray[np.bool_], weights: Array, voxel_m: float
) -> NDArray[np.bool_]:
    """The part of a selection (N,) that hangs together on a voxel grid, heaviest piece."""
    indices = np.flatnonzero(which)
    if not len(indices):
        return which
    low, high = np.quantile(points[indices], [0.005, 0.995], axis=0)
    inner = np.all((points[indices] >= low - 2 * voxel_m) & (points[indices] <= high + 2 * voxel_m), 1)
    indices = indices[inner]
    cells = np.floor((points[indices] - low) / voxel_m).astype(int) + 3
    shape = tuple(np.minimum(cells.max(0) + 2, 400))
    cells = np.minimum(cells, np.array(shape) - 1)
    grid = np.zeros(shape, bool)
    grid[tuple(cells.T)] = True
    pieces = np.zeros(shape, np.int32)
    connected(grid, np.ones((3, 3, 3)), output=pieces)
    mine = pieces[tuple(cells.T)]
    totals = np.bincount(mine, weights=weights[indices])
    result = np.zeros(len(which), bool)
    result[indices[mine == int(np.argmax(totals))]] = True
    return result
