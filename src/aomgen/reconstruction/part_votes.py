"""Labels by vote: masks asked again in more views, for parts that no panel explains."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label as connected
from scipy.spatial import cKDTree

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.reconstruction.part_masks import PartMasks, ScanView, drawn_parts, lift, prompt_again
from aomgen.reconstruction.prompted import ObjectLabels, PromptedImage
from aomgen.reconstruction.segmenter import PreparedImage, Segmenter

STAGE = "parts"
# Views asked again from geometry, beside the prompted ones.
EXTRA_VIEWS = 6
# Size of the grid on which pieces of a part must touch.
VOXEL_M = 0.02


def vote_parts(
    gaussians: Gaussians,
    views: list[ScanView],
    prompted: list[PromptedImage],
    segmenter: Segmenter,
    bodies: NDArray[np.int32],
    progress: Progress,
) -> ObjectLabels:
    """Label the object's Gaussians by masks of more views.

    Args:
        gaussians: The scan, world frame.
        views: Scan images.
        prompted: What the prompts found; gives the first guess.
        segmenter: Asked in more views.
        bodies: (N,) robot bodies, -1 where a Gaussian is not of the robot.
        progress: Told about each view.

    Raises:
        ReconstructionError: No view confirms the first guess.
    """
    labels = np.zeros(len(gaussians), np.uint8)
    for value in (STATIC, MOVING):
        inside, seen = np.zeros(len(gaussians)), np.zeros(len(gaussians))
        for item in prompted:
            if item.part == value:
                mask = item.best_mask
                weights = lift(gaussians, item.view, [mask, ~mask & ~item.view.robot])
                inside += weights[:, 0]
                seen += weights.sum(1)
        found = (inside > 0.6 * seen) & (inside > 0.05) & (bodies < 0)
        labels[_largest_piece(gaussians.means, found, inside, VOXEL_M)] = value
    progress(0.1, "prompts lifted")
    prepared = {item.view.name: item.prepared for item in prompted}
    masks = _ask_views(gaussians, labels, views, prepared, segmenter, progress)
    labels, confidence = _vote(gaussians, labels, masks, bodies)
    names = tuple(sorted(item.view.name for item in masks))
    return ObjectLabels.judged(gaussians, prompted, labels, confidence, names, "vote")


def _ask_views(
    gaussians: Gaussians,
    labels: NDArray[np.uint8],
    views: list[ScanView],
    prepared: dict[str, PreparedImage],
    segmenter: Segmenter,
    progress: Progress,
) -> list[PartMasks]:
    center = np.median(gaussians.means[labels > 0], 0)
    by_name = {view.name: view for view in views}
    masks = []
    order = list(prepared)
    directions = {view.name: _direction(view, center) for view in views}
    while len(order) - len(prepared) < EXTRA_VIEWS:
        candidates = [view for view in views if view.name not in order]
        if not candidates:
            break
        taken = np.array([directions[name] for name in order])
        gaps = [np.linalg.norm(taken - directions[view.name], axis=1).min() for view in candidates]
        for index in np.argsort(gaps)[::-1]:
            if _shows_object(gaussians, labels, candidates[index]):
                order.append(candidates[index].name)
                break
        else:
            break
    for index, name in enumerate(order):
        view = by_name[name]
        image = prepared.get(name) or segmenter.prepare(name, view.image_srgb)
        answer = prompt_again(view, image, gaussians, labels)
        if answer is not None:
            masks.append(answer)
        progress(0.1 + 0.9 * (index + 1) / len(order), f"view {index + 1} of {len(order)}")
    if not masks:
        raise ReconstructionError(
            STAGE, "no view confirms the prompted parts", "check the boxes of the moving and the static part"
        )
    return masks


def _direction(view: ScanView, center: Array) -> Array:
    offset = view.camera.center - center
    return offset / np.linalg.norm(offset)


def _shows_object(gaussians: Gaussians, labels: NDArray[np.uint8], view: ScanView) -> bool:
    """Whether the object is large enough in a view and not much hidden by the robot or the border."""
    small = view.camera.resized(160, max(1, round(160 * view.camera.height / view.camera.width)))
    pixels, depths = small.project(gaussians.means[labels > 0][::5])
    inside = (depths > 0) & np.all((pixels > 2) & (pixels < [small.width - 2, small.height - 2]), 1)
    if not inside.mean() > 0.95:
        return False
    drawn = drawn_parts(gaussians, labels, small)
    return bool((drawn[STATIC] | drawn[MOVING]).mean() > 0.01)


def _vote(
    gaussians: Gaussians,
    labels: NDArray[np.uint8],
    masks: list[PartMasks],
    bodies: NDArray[np.int32],
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Labels and confidence from the masks of all answered views."""
    values = np.array([BACKGROUND, STATIC, MOVING], np.uint8)
    votes = np.zeros((len(gaussians), 3))
    for item in masks:
        rest = ~item.moving & ~item.static & ~item.view.robot
        votes += lift(gaussians, item.view, [rest, item.static, item.moving])
    seen = votes.sum(1)
    winner = values[np.argmax(votes, 1)]
    confidence = votes.max(1) / np.maximum(seen, 1e-9)
    known = (seen > 0.02) & (bodies < 0)
    winner[~known], confidence[~known] = BACKGROUND, 0.0
    winner = _fill_unseen(gaussians, winner, known, bodies)
    result = np.zeros(len(gaussians), np.uint8)
    for value, column in ((STATIC, 1), (MOVING, 2)):
        piece = _largest_piece(gaussians.means, winner == value, votes[:, column] + 1e-6, VOXEL_M)
        result[piece] = value
    return result, confidence.astype(np.float32)


def _fill_unseen(
    gaussians: Gaussians,
    labels: NDArray[np.uint8],
    known: NDArray[np.bool_],
    bodies: NDArray[np.int32],
) -> NDArray[np.uint8]:
    """Gaussians that no asked view shows take the label of their nearest neighbours."""
    unseen = np.flatnonzero(~known & (bodies < 0))
    if not len(unseen) or known.sum() < 8:
        return labels
    distances, nearest = cKDTree(gaussians.means[known]).query(gaussians.means[unseen], k=8)
    around = labels[known][nearest]
    counts = np.stack([(around == value).sum(1) for value in range(4)], 1)
    filled = labels.copy()
    filled[unseen] = np.where(np.median(distances, 1) < 1.5 * VOXEL_M, np.argmax(counts, 1), BACKGROUND)
    return filled


def _largest_piece(
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
