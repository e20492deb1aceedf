"""Masks of everything in some views of a scan, from a grid of points. [paper 4.1]

Every grid point prompts the segmenter; resulting masks that are uncertain, tiny, nearly the
whole image or a repetition of a better one are dropped (as in Segment Anything, Kirillov et al., 2023,
sec. 4). A view's masks are stored as soon as they are found, so that a killed run goes on where it was.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress
from aomgen.core.values import Array
from aomgen.errors import MalformedFileError
from aomgen.io.artifact import npz_bytes, read_npz
from aomgen.io.atomic import write_bytes
from aomgen.parts.prompted_images import PromptedImage
from aomgen.parts.scan_views import ScanView
from aomgen.segmentation.interface import PointMasks, Segmenter
from aomgen.splatting.surfaces import compute_surface_points

MASKS_FOLDER = "automatic_masks"
# Least IoU that the segmenter predicts for its mask, and between its tighter and looser cut; IoU above which
# two masks are duplicates: the default of SAM 2's mask generator.
GOOD_IOU = 0.8
# Shares of the image that a mask covers: below a speck, above the image itself.
SHARES = (0.0005, 0.9)
# Points along either side of an image, and of the prompted object's box in it.
GRID_SIDE, OBJECT_SIDE = 8, 6


def segment_views(
    gaussians: Gaussians,
    views: Sequence[ScanView],
    prompted: Sequence[PromptedImage],
    segmenter: Segmenter,
    progress: Progress,
    count: int,
    folder: Path | None = None,
) -> dict[str, NDArray[np.bool_]]:
    """Segment a few views wholly; those found earlier are read back from the folder.

    Args:
        gaussians: The scene, world frame; locates the prompted object in other views.
        views: Scan views, world frame, held-out ones left out.
        count: Views that are segmented, the prompted ones among them.
        folder: Holds one file a view; None keeps nothing. It must belong to these views and this
            segmenter: nothing here compares them.

    Returns:
        Masks (M, H, W) by view name: those of the prompts first, then those of the grid, best first.

    Raises:
        MalformedFileError: A stored file is damaged.
    """
    prepared = {item.view.name: item.prepared for item in prompted}
    chosen = spread_views(views, list(prepared), count)
    points = [
        compute_surface_points(gaussians, item.view.camera)[item.best_mask]
        for item in prompted
        if item.part == STATIC
    ]
    points_world = np.concatenate([np.zeros((0, 3)), *points])
    points_world = points_world[np.isfinite(points_world[:, 0])]
    found = {}
    for index, view in enumerate(chosen):
        path = None if folder is None else folder / f"{Path(view.name).stem}.npz"
        if path is not None and path.is_file():
            masks = load_masks(path)
        else:
            image = prepared.get(view.name) or segmenter.prepare(view.name, view.image_srgb)
            grid = grid_points(view.robot.shape, GRID_SIDE, view.robot)
            grid = np.concatenate([grid, _object_grid(view, points_world)])
            masks = best_masks(image.at_points(grid), view.robot)
            if path is not None:
                save_masks(path, masks)
        answers = [item.best_mask for item in prompted if item.view.name == view.name]
        found[view.name] = np.array([*answers, *masks], bool)
        progress((index + 1) / len(chosen), f"{len(masks)} masks in view {index + 1} of {len(chosen)}")
    return found


def spread_views(views: Sequence[ScanView], first: Sequence[str], count: int) -> list[ScanView]:
    """Named views, then repeatedly the view farthest from all chosen ones, until there are enough."""
    chosen = [view for view in views if view.name in first] or list(views[:1])
    rest = [view for view in views if view.name not in {item.name for item in chosen}]
    while rest and len(chosen) < count:
        taken = np.array([view.camera.center for view in chosen])
        gaps = [float(np.linalg.norm(taken - view.camera.center, axis=1).min()) for view in rest]
        chosen.append(rest.pop(int(np.argmax(gaps))))
    return chosen


def grid_points(shape: tuple[int, ...], side: int, skip: NDArray[np.bool_]) -> Array:
    """Centres (N, 2), [px], of a side x side division of an image (H, W), without those on `skip`."""
    steps = (np.arange(side) + 0.5) / side
    points = np.stack(np.meshgrid(steps * shape[1], steps * shape[0]), -1).reshape(-1, 2)
    columns, rows = np.floor(points).astype(int).T
    return points[~skip[rows, columns]]


def _object_grid(view: ScanView, points_world: Array) -> Array:
    """Points (N, 2), [px], in the box of some points as a view sees them, without those on the robot."""
    height, width = view.robot.shape
    pixels, depths = view.camera.project(points_world)
    pixels = pixels[depths > 0]
    if not len(pixels):
        return np.zeros((0, 2))
    low, high = np.clip(np.quantile(pixels, [0.02, 0.98], axis=0), 0, [width - 1, height - 1])
    x0, y0 = np.floor(low).astype(int)
    x1, y1 = np.ceil(high).astype(int) + 1
    return grid_points((y1 - y0, x1 - x0), OBJECT_SIDE, view.robot[y0:y1, x0:x1]) + [x0, y0]


def best_masks(answers: PointMasks, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The good ones (M, H, W) among many masks without what is `known`, best first, without duplicates."""
    masks = answers.masks & ~known
    shares = masks.mean((1, 2))
    good = (np.minimum(answers.quality, answers.stability) >= GOOD_IOU) & (shares >= SHARES[0])
    good &= shares <= SHARES[1]
    # Every fourth row and column estimates overlaps well enough, and sixteen times faster.
    small = masks[:, 1::4, 1::4].astype(np.float32)
    shared, areas = np.tensordot(small, small, ((1, 2), (1, 2))), small.sum((1, 2))
    overlaps = shared / np.maximum(areas[:, None] + areas - shared, 1)
    kept: list[int] = []
    for index in np.argsort(-answers.quality * answers.stability, kind="stable"):
        if good[index] and np.all(overlaps[index, kept] <= GOOD_IOU):
            kept.append(int(index))
    return masks[kept]


def save_masks(path: Path, masks: NDArray[np.bool_]) -> None:
    """Write the masks (M, H, W) of one view, eight pixels a byte."""
    write_bytes(path, npz_bytes({"packed": np.packbits(masks, axis=-1), "width": np.array(masks.shape[2])}))


def load_masks(path: Path) -> NDArray[np.bool_]:
    """Read what `save_masks` wrote.

    Raises:
        MalformedFileError: The file is damaged.
    """
    arrays = read_npz(path)
    try:
        return np.unpackbits(arrays["packed"], axis=-1, count=int(arrays["width"])).astype(bool)
    except (ValueError, KeyError, TypeError) as error:
        raise MalformedFileError(path, f"does not hold masks ({error})", "delete it") from error
