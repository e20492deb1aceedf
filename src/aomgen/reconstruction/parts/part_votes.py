"""Labels by vote: masks asked again in more views, for parts that no panel explains."""

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.reconstruction.masks.segmenter import PreparedImage, Segmenter
from aomgen.reconstruction.parts.part_masks import (
    PartMasks,
    ScanView,
    drawn_parts,
    lift,
    prompt_again,
    shown_by,
)
from aomgen.reconstruction.parts.pieces import VOXEL_M, largest_piece, settled
from aomgen.reconstruction.parts.prompted import ObjectLabels, PromptedImage

STAGE = "parts"
# Views asked again from geometry, beside the prompted ones.
EXTRA_VIEWS = 6


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
        masks = ((item.view, item.best_mask) for item in prompted if item.part == value)
        shown, inside = shown_by(gaussians, masks)
        labels[largest_piece(gaussians.means, shown & (bodies < 0), inside, VOXEL_M)] = value
    progress(0.1, "prompts lifted")
    prepared = {item.view.name: item.prepared for item in prompted}
    masks = _ask_views(gaussians, labels, views, prepared, segmenter, progress)
    votes = np.zeros((len(gaussians), 3))
    for item in masks:
        rest = ~item.moving & ~item.static & ~item.view.robot
        votes += lift(gaussians, item.view, [rest, item.static, item.moving])
    labels, confidence = settled(gaussians.means, votes, bodies < 0)
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
