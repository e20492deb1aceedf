"""Parts of the object from affinity features: automatic masks, training, one query a part. [paper 4.1]"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress, part
from aomgen.core.values import Array
from aomgen.parts.affinity import Affinity, SizedMasks, measure_masks, surface_depth
from aomgen.parts.affinity_query import Query, QueryAnswer, answer_query
from aomgen.parts.affinity_training import AffinityParams, train_affinity
from aomgen.parts.likelihood import PartEvidence
from aomgen.parts.prompted_images import PromptedImage
from aomgen.parts.scan_views import ScanView
from aomgen.segmentation.automatic_masks import (
    ViewMasks,
    best_masks,
    grid_points,
    masks_of_views,
)
from aomgen.segmentation.interface import Segmenter

# No feature is surer than this.
LEAST_VOTE = 0.02
# Cosine similarity over which a vote turns from the rest to the part: the width of the logistic step.
SOFTNESS = 0.05
# Points of the grid along either side of an image; the prompted object has a denser grid of its own.
GRID_SIDE = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class AffinityPartsParams:
    """Effort of the parts from affinity features.

    Attributes:
        views: Views that are segmented, the prompted ones among them.
        object_side: Points along either side of the prompted object's box, beside the image's grid.
        training: Of the features.
        masks_folder: Keeps the masks of each view for a run that goes on, see `masks_of_views`;
            None keeps nothing.
    """

    views: int = 12
    object_side: int = 6
    training: AffinityParams = field(default_factory=AffinityParams)
    masks_folder: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class MaskedScan:
    """Some scan views with everything that was found in them.

    Attributes:
        views: The views.
        found: Masks by view name: answers to the prompts first, then what the grid found.
    """

    views: tuple[ScanView, ...]
    found: Mapping[str, NDArray[np.bool_]]


def find_all_masks(
    gaussians: Gaussians,
    views: Sequence[ScanView],
    prompted: Sequence[PromptedImage],
    segmenter: Segmenter,
    progress: Progress,
    params: AffinityPartsParams,
) -> MaskedScan:
    """Segment a few views wholly.

    Args:
        gaussians: The scene, world frame; tells where the prompted object lies in other views.
        views: Scan views in the world frame, held-out ones left out.
        prompted: Answers to the prompts.
        segmenter: Turns points into masks.
        progress: Called about each view.
        params: Effort, and where masks are kept.
    """
    prepared = {item.view.name: item.prepared for item in prompted}
    chosen = spread_views(views, list(prepared), params.views)
    by_name = {view.name: view for view in chosen}
    static = [points_under(gaussians, item) for item in prompted if item.part == STATIC]
    points_world = np.concatenate([np.zeros((0, 3)), *static])

    def find(name: str) -> ViewMasks:
        view = by_name[name]
        image = prepared.get(name) or segmenter.prepare(name, view.image_srgb)
        points = np.concatenate(
            [
                grid_points(view.robot.shape, GRID_SIDE, view.robot),
                _object_grid(view, points_world, params.object_side),
            ]
        )
        return best_masks(image.at_points(points), view.robot)

    found = masks_of_views(list(by_name), find, params.masks_folder, progress)
    answers = {name: [item.best_mask for item in prompted if item.view.name == name] for name in by_name}
    return MaskedScan(
        views=tuple(chosen),
        found={name: np.array([*answers[name], *item.masks], bool) for name, item in found.items()},
    )


def points_under(gaussians: Gaussians, item: PromptedImage) -> Array:
    """Points (N, 3), world frame, that the answer to a prompt shows; the middle nine tenths in depth."""
    view = item.view
    depth = surface_depth(gaussians, view.camera)
    shown = item.best_mask & (depth > 0)
    if not shown.any():
        return np.zeros((0, 3))
    low, high = np.quantile(depth[shown], [0.05, 0.95])
    rows, columns = np.nonzero(shown & (depth >= low) & (depth <= high))
    rays = view.camera.directions()[rows, columns]
    return view.camera.center + rays * depth[rows, columns][:, None]


def _object_grid(view: ScanView, points_world: Array, side: int) -> Array:
    """Points (N, 2), [px], in the box of some points as a view sees them, without those on the robot."""
    height, width = view.robot.shape
    pixels, depths = view.camera.project(points_world)
    pixels = pixels[depths > 0]
    if not len(pixels):
        return np.zeros((0, 2))
    low, high = np.clip(np.quantile(pixels, [0.01, 0.99], axis=0), 0, [width - 1, height - 1])
    x0, y0 = np.floor(low).astype(int)
    x1, y1 = np.ceil(high).astype(int) + 1
    return grid_points((y1 - y0, x1 - x0), side, view.robot[y0:y1, x0:x1]) + [x0, y0]


def affinity_of(
    gaussians: Gaussians, scan: MaskedScan, progress: Progress, params: AffinityPartsParams
) -> Affinity:
    """Affinity features of all Gaussians from a segmented scan.

    Masks larger than the ring of cameras are left out: they show the room, not a thing in it.
    """
    centers = np.array([view.camera.center for view in scan.views])
    largest_m = 2 * float(np.linalg.norm(centers.std(axis=0)))
    sized = []
    for view in scan.views:
        item = measure_masks(gaussians, view.camera, scan.found[view.name], params.training.width)
        kept = item.sizes_m <= largest_m
        sized.append(SizedMasks(camera=item.camera, masks=item.masks[kept], sizes_m=item.sizes_m[kept]))
    return train_affinity(gaussians, sized, progress, params.training)


def query_parts(
    gaussians: Gaussians, affinity: Affinity, prompted: Sequence[PromptedImage], params: AffinityPartsParams
) -> dict[int, QueryAnswer]:
    """How well every Gaussian fits the prompted object (`STATIC`) and its moving part (`MOVING`)."""
    answers: dict[int, QueryAnswer] = {}
    for value in (STATIC, MOVING):
        queries = [
            Query(camera=item.view.camera, mask=item.best_mask, ignored=item.view.robot)
            for item in prompted
            if item.part == value
        ]
        whole = answers.get(STATIC)
        within = None if whole is None else whole.similarities > whole.threshold
        answers[value] = answer_query(gaussians, affinity, queries, params.training.width, within)
    return answers


def affinity_votes(answers: Mapping[int, QueryAnswer]) -> Array:
    """Votes (N, 3) for background, static part and moving part; each row sums to 1.

    A prompt of the static part shows the whole object, the moving part lies on it.
    """
    shares = {}
    for value, answer in answers.items():
        margin = (answer.similarities.astype(np.float64) - answer.threshold) / SOFTNESS
        shares[value] = 1 / (1 + np.exp(-np.clip(margin, -50, 50)))
    moving = shares[MOVING]
    static = shares[STATIC] * (1 - moving)
    return np.stack([1 - moving - static, static, moving], axis=1)


def spread_views(views: Sequence[ScanView], first: Sequence[str], count: int) -> list[ScanView]:
    """Named views, then those farthest from all chosen so far, until there are enough."""
    by_name = {view.name: view for view in views}
    chosen = [by_name[name] for name in dict.fromkeys(first)]
    rest = [view for view in views if view.name not in first]
    if not chosen and rest:
        chosen.append(rest.pop(0))
    while rest and len(chosen) < count:
        taken = np.array([view.camera.center for view in chosen])
        gaps = [float(np.linalg.norm(taken - view.camera.center, axis=1).min()) for view in rest]
        chosen.append(rest.pop(int(np.argmax(gaps))))
    return chosen


def affinity_evidence(
    gaussians: Gaussians,
    scan: MaskedScan,
    prompted: list[PromptedImage],
    progress: Progress,
    params: AffinityPartsParams,
) -> PartEvidence:
    """Train and query: log-likelihoods of the object's parts.

    Args:
        gaussians: The scene, world frame.
        scan: Its masks.
        prompted: Answers to the prompts.
        progress: Called now and then.
        params: Effort.

    Raises:
        ReconstructionError: There are no masks, or the prompts show nothing.
    """
    affinity = affinity_of(gaussians, scan, part(progress, 0.0, 0.95), params)
    votes = affinity_votes(query_parts(gaussians, affinity, prompted, params))
    progress(1.0, "parts queried")
    return PartEvidence(log_likelihoods=np.log(np.maximum(votes, LEAST_VOTE)), method="saga")
