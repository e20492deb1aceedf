"""Parts of the object from affinity features: automatic masks, training, and one query for each part. [paper 4.1]

In some views every point of a grid prompts the segmenter. Masks that are uncertain, tiny, almost as large as the
image, or duplicates of a better mask are dropped (as in Segment Anything, Kirillov et al., 2023, sec. 4). The masks
of a view are stored as soon as they are computed, so that a killed run can continue.

The mask of a prompt in its view determines the size and the features of the part. The threshold of the similarity is
the one whose rendering agrees best with the mask of the prompt. Source: SAGA (Cen et al., AAAI 2025), sec. 3.4, where
the user sets size and threshold.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress, part
from aomgen.core.values import Array
from aomgen.errors import MalformedFileError, ReconstructionError
from aomgen.io.artifact import npz_bytes, read_npz
from aomgen.io.atomic import write_bytes
from aomgen.io.reuse import reuse
from aomgen.paper.affinity_features import (
    AffinityParams,
    FeaturesAt,
    SizedMasks,
    at_resolution,
    measure_masks,
    train_affinity,
    unit,
)
from aomgen.parts.likelihood import PartEvidence
from aomgen.parts.prompted_images import PromptedImage
from aomgen.parts.scan_views import ScanView
from aomgen.segmentation.interface import PointMasks, Segmenter
from aomgen.splatting.rasterizer import contribution_weights, render
from aomgen.splatting.surfaces import compute_surface_points

# Least probability of a label, because no feature is certain.
LEAST_VOTE = 0.02
# Width of the logistic function that maps similarities to probabilities (cosine similarity).
SOFTNESS = 0.05
# Thresholds whose IoU is at least this share of the best one are equally good, within the accuracy of mask outlines.
PLATEAU = 0.97
MASKS_FOLDER = "automatic_masks"
# Least IoU that the segmenter predicts for its mask, and between its tighter and looser cut; IoU above which
# two masks are duplicates: the default of SAM 2's mask generator.
GOOD_IOU = 0.8
# Smallest and largest share of the image that a mask may cover.
SHARES = (0.0005, 0.9)
# Points along either side of an image, and of the prompted object's box in it.
GRID_SIDE, OBJECT_SIDE = 8, 6


def affinity_evidence(
    gaussians: Gaussians,
    views: Sequence[ScanView],
    found: Mapping[str, NDArray[np.bool_]],
    prompted: Sequence[PromptedImage],
    progress: Progress,
    params: AffinityParams,
    rng: np.random.Generator,
) -> PartEvidence:
    """Train affinity features and query the parts; return log-likelihoods of the object's parts.

    Args:
        found: Masks of some of the views by name, see `segment_views`.

    Raises:
        ReconstructionError: There are no masks, or the prompts contain no Gaussians.
    """
    chosen = [view for view in views if view.name in found]
    centers = np.array([view.camera.center for view in chosen])
    # Masks larger than the extent of the cameras show the room, not an object in it.
    largest_m = 2 * float(np.linalg.norm(centers.std(axis=0)))
    sized = []
    for view in chosen:
        item = measure_masks(gaussians, view.camera, found[view.name], params.width)
        kept = item.sizes_m <= largest_m
        sized.append(SizedMasks(camera=item.camera, masks=item.masks[kept], sizes_m=item.sizes_m[kept]))
    features_at = train_affinity(gaussians, sized, part(progress, 0.0, 0.95), params, rng)
    static, moving = ([item for item in prompted if item.part == value] for value in (STATIC, MOVING))
    whole, _ = query_part(gaussians, features_at, static, params.width)
    moves = _vote(query_part(gaussians, features_at, moving, params.width, whole > 0)[0])
    # A prompt of the static part contains the whole object, including the moving part.
    stands = _vote(whole) * (1 - moves)
    progress(1.0, "parts queried")
    votes = np.stack([1 - moves - stands, stands, moves], axis=1)
    return PartEvidence(log_likelihoods=np.log(np.maximum(votes, LEAST_VOTE)), method="saga")


def query_part(
    gaussians: Gaussians,
    features_at: FeaturesAt,
    prompted: Sequence[PromptedImage],
    width: int,
    within: NDArray[np.bool_] | None = None,
) -> tuple[Array, float]:
    """Compute the similarity of all Gaussians to a prompted part, minus the threshold for belonging to it.

    As an alternative, the part is separated only from the rest of its object: views of other sides of the object
    train which Gaussians belong to the object, but hardly their distance from the part. The alternative that renders
    the prompt's mask better is used.

    Args:
        gaussians: N Gaussians, world frame.
        width: Width at which features are rendered, [px].
        within: (N,), the Gaussians of a larger object that contains the part; None for a
            separate object.

    Returns:
        Cosine similarity (N,) minus the threshold, positive for Gaussians of the part, and the IoU between
        the rendering of these Gaussians and the masks of the prompts.

    Raises:
        ReconstructionError: No prompt contains Gaussians.
        BackendError: The engine is missing.
    """
    shown = [
        (item, sized)
        for item in prompted
        if len((sized := measure_masks(gaussians, item.view.camera, item.best_mask[None], width)).masks)
    ]
    if not shown:
        raise ReconstructionError("affinity", "the prompts show nothing of the scene", "check their boxes")
    features = features_at(float(np.median([sized.sizes_m[0] for _, sized in shown])))
    seen, painted, rest = [], np.zeros(len(gaussians)), np.zeros(len(gaussians))
    for item, sized in shown:
        drawn, mask = render(gaussians, sized.camera, features=features), sized.masks[0]
        other = ~mask & (drawn.alpha > 0.5) & ~at_resolution(item.view.robot, sized.camera)
        seen.append(unit(unit(np.asarray(drawn.features))[mask].mean(0)))
        weights = contribution_weights(gaussians, sized.camera, np.stack([mask, other]).astype(np.float32))
        painted += weights[:, 0]
        rest += weights[:, 1]
    directions = [unit(np.mean(seen, axis=0))]
    if within is not None:
        painted, rest = painted * within, rest * within
        inside, outside = (unit(np.asarray(weights @ features, np.float32)) for weights in (painted, rest))
        directions.append(unit(inside - outside))
    found = []
    for direction in directions:
        fit = features @ direction
        similarities = fit if within is None else np.where(within, fit, -1).astype(np.float32)
        threshold, iou = best_threshold(similarities, painted, rest)
        found.append((similarities.astype(np.float64) - threshold, iou))
    return max(found, key=lambda item: item[1])


def best_threshold(similarities: NDArray[np.float32], inside: Array, outside: Array) -> tuple[float, float]:
    """Find the threshold that agrees best with the masks, and its IoU; values (N,) above it belong to the part.

    If several thresholds agree equally well, the middle one is used.

    Args:
        inside: (N,), contribution of each Gaussian to the pixels of the part.
        outside: (N,), contribution of each Gaussian to other pixels.
    """
    order = np.argsort(-similarities)
    hits = np.cumsum(inside[order])
    ious = hits / np.maximum(inside.sum() + np.cumsum(outside[order]), 1e-9)
    good = np.flatnonzero(ious >= PLATEAU * ious.max())
    cut = (similarities[order[good[0]]] + similarities[order[good[-1]]]) / 2
    return float(cut), float(ious.max())


def _vote(margins: Array) -> Array:
    """Compute the probability (N,) of belonging to the part."""
    return 1 / (1 + np.exp(-np.clip(margins / SOFTNESS, -50, 50)))


def segment_views(
    gaussians: Gaussians,
    views: Sequence[ScanView],
    prompted: Sequence[PromptedImage],
    segmenter: Segmenter,
    progress: Progress,
    count: int,
    folder: Path | None = None,
) -> dict[str, NDArray[np.bool_]]:
    """Segment a few views completely; stored masks are read from the folder.

    Args:
        gaussians: The scene, world frame; locates the prompted object in other views.
        views: Scan views, world frame, without held-out ones.
        count: Number of segmented views, including the prompted ones.
        folder: Folder with one file for each view; None stores no masks. It must belong to these views and this
            segmenter, which is not checked. The masks of a damaged file are computed again.

    Returns:
        Masks (M, H, W) by view name: those of the prompts first, then those of the grid, best first.
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
        masks = None if path is None else reuse(path, partial(load_masks, path))
        if masks is None:
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
    """Select the named views, then repeatedly the view farthest from all selected ones."""
    chosen = [view for view in views if view.name in first] or list(views[:1])
    rest = [view for view in views if view.name not in {item.name for item in chosen}]
    while rest and len(chosen) < count:
        taken = np.array([view.camera.center for view in chosen])
        gaps = [float(np.linalg.norm(taken - view.camera.center, axis=1).min()) for view in rest]
        chosen.append(rest.pop(int(np.argmax(gaps))))
    return chosen


def grid_points(shape: tuple[int, ...], side: int, skip: NDArray[np.bool_]) -> Array:
    """Compute the centers (N, 2), [px], of a side x side grid of an image (H, W), without those on `skip`."""
    steps = (np.arange(side) + 0.5) / side
    points = np.stack(np.meshgrid(steps * shape[1], steps * shape[0]), -1).reshape(-1, 2)
    columns, rows = np.floor(points).astype(int).T
    return points[~skip[rows, columns]]


def _object_grid(view: ScanView, points_world: Array) -> Array:
    """Compute a grid (N, 2), [px], in the bounding box of projected points, without the pixels of the robot."""
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
    """Select good masks (M, H, W) without the pixels `known` and without duplicates, the best first."""
    masks = answers.masks & ~known
    shares = masks.mean((1, 2))
    good = (np.minimum(answers.quality, answers.stability) >= GOOD_IOU) & (shares >= SHARES[0])
    good &= shares <= SHARES[1]
    # Every fourth row and column is sufficient to estimate overlaps, and sixteen times faster.
    small = masks[:, 1::4, 1::4].astype(np.float32)
    shared, areas = np.tensordot(small, small, ((1, 2), (1, 2))), small.sum((1, 2))
    overlaps = shared / np.maximum(areas[:, None] + areas - shared, 1)
    kept: list[int] = []
    for index in np.argsort(-answers.quality * answers.stability, kind="stable"):
        if good[index] and np.all(overlaps[index, kept] <= GOOD_IOU):
            kept.append(int(index))
    return masks[kept]


def save_masks(path: Path, masks: NDArray[np.bool_]) -> None:
    """Write the masks (M, H, W) of one view, with eight pixels in a byte."""
    write_bytes(path, npz_bytes({"packed": np.packbits(masks, axis=-1), "width": np.array(masks.shape[2])}))


def load_masks(path: Path) -> NDArray[np.bool_]:
    """Read a file that `save_masks` wrote.

    Raises:
        MalformedFileError: The file is damaged.
    """
    arrays = read_npz(path)
    try:
        return np.unpackbits(arrays["packed"], axis=-1, count=int(arrays["width"])).astype(bool)
    except (ValueError, KeyError, TypeError) as error:
        raise MalformedFileError(path, f"does not hold masks ({error})", "delete it") from error
