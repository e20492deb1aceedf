"""Masks of the object's two parts in several scan images, from a few prompts.

The prompts give a first guess in 3D; it is drawn into other views, and its box there prompts the
segmenter again. Masks are never carried from image to image by appearance.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from aomgen.conventions import MOVING, STATIC
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array
from aomgen.errors import BackendError
from aomgen.reconstruction.masks.segmenter import Mask, PreparedImage, clean
from aomgen.splatting.rasterizer import contribution_weights, render

MIN_AREA_PX = 120
# A Gaussian belongs to what this share of its pixels shows, once it has painted as much as this, [px].
MIN_INSIDE, MIN_SHOWN = 0.6, 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanView:
    """A scan image in the world frame, with the pixels where the aligned robot is drawn."""

    name: str
    camera: Camera
    image_srgb: NDArray[np.uint8]
    robot: Mask


@dataclass(frozen=True, slots=True, kw_only=True)
class PartMasks:
    """Masks (H, W) of both parts in one view; they do not overlap one another or the robot."""

    view: ScanView
    moving: Mask
    static: Mask


def lift(gaussians: Gaussians, view: ScanView, masks: list[Mask]) -> NDArray[np.float32]:
    """Blended weight (N, M) of every Gaussian in each mask of one view."""
    return contribution_weights(gaussians, view.camera, np.stack(masks).astype(np.float32))


def shown_by(gaussians: Gaussians, masks: Iterable[tuple[ScanView, Mask]]) -> tuple[NDArray[np.bool_], Array]:
    """Which Gaussians (N,) masks show, and their blended weight (N,) inside of them.

    Args:
        gaussians: World frame.
        masks: Views, and what a mask (H, W) is of in each.
    """
    inside, seen = np.zeros(len(gaussians)), np.zeros(len(gaussians))
    for view, mask in masks:
        weights = lift(gaussians, view, [mask, ~mask & ~view.robot])
        inside += weights[:, 0]
        seen += weights.sum(1)
    return (inside > MIN_INSIDE * seen) & (inside > MIN_SHOWN), inside


def drawn_parts(gaussians: Gaussians, labels: NDArray[np.uint8], camera: Camera) -> dict[int, Mask]:
    """Masks of static and moving part as their Gaussians paint them, occlusion included."""
    features = np.stack([labels == STATIC, labels == MOVING], 1).astype(np.float32)
    shares = render(gaussians, camera, features=features).features
    if shares is None:
        raise BackendError("rasterizer", "drew no features", "rebuild the engine")
    return {STATIC: shares[..., 0] > 0.5, MOVING: shares[..., 1] > 0.5}


def prompt_again(
    view: ScanView, prepared: PreparedImage, gaussians: Gaussians, labels: NDArray[np.uint8]
) -> PartMasks | None:
    """Ask the segmenter about a view with boxes drawn from the present labels.

    The whole object and its moving part are asked for, since segmenters find whole objects best;
    the static part is what is left. None when an answer and the drawing disagree too much.
    """
    drawn = drawn_parts(gaussians, labels, view.camera)
    whole = _asked(prepared, "object", clean_drawn(drawn[STATIC] | drawn[MOVING]), view.robot, 0.65)
    if whole is None or not whole.any():
        return None
    moving = _asked(prepared, "moving", clean_drawn(drawn[MOVING]), view.robot, 0.5)
    if moving is None:
        return None
    return PartMasks(view=view, moving=moving, static=whole & ~moving)


def clean_drawn(mask: Mask) -> Mask:
    """A drawn mask without specks; empty when nearly nothing is left."""
    if mask.sum() < MIN_AREA_PX:
        return np.zeros_like(mask)
    tidy = clean(mask)
    return tidy if tidy.sum() >= MIN_AREA_PX else np.zeros_like(mask)


def _asked(prepared: PreparedImage, part: str, drawn: Mask, robot: Mask, min_iou: float) -> Mask | None:
    if not drawn.any():
        return drawn
    rows, columns = np.flatnonzero(drawn.any(1)), np.flatnonzero(drawn.any(0))
    box = [columns[0] - 1, rows[0] - 1, columns[-1] + 2, rows[-1] + 2]
    free = drawn & ~robot
    inside = np.asarray(distance_transform_edt(np.pad(free, 1)))
    row, column = np.unravel_index(int(np.argmax(inside)), inside.shape)
    points = np.array([[column - 0.5, row - 0.5, 1.0]])
    best, best_iou = None, min_iou
    # A point may pull the mask to a detail (a label, a window), its absence to a neighbour.
    for clicks in (np.zeros((0, 3)), points):
        mask = prepared.mask(part, box, clicks) & ~robot
        iou = (mask & free).sum() / max(1, (mask | free).sum())
        if iou > best_iou:
            best, best_iou = mask, iou
    return best
