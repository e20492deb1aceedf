"""Which Gaussians belong to a prompted thing, from affinity features.

The prompt's mask in its own view says how large the thing is and what its features look like; the
similarity above which a Gaussian belongs to it is the one that paints the prompt's mask best.
A part of a known thing may be told from the rest of that thing instead: views of the thing's other
sides train what belongs to it, but hardly how far they are from the part. What paints the prompt's mask
better is taken.
Source: SAGA (Cen et al., AAAI 2025), sec. 3.4; there the size and the threshold are set by hand.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array
from aomgen.errors import BackendError, ReconstructionError
from aomgen.parts.affinity import SOLID_ALPHA, Affinity, measure_masks, unit
from aomgen.splatting.rasterizer import contribution_weights, render

STAGE = "affinity"
# Cuts this close to the best IoU count as equally good: outlines in masks are no sharper.
PLATEAU = 0.97


@dataclass(frozen=True, slots=True, kw_only=True)
class Query:
    """A thing as one view shows it.

    Attributes:
        camera: The view at full resolution, world frame.
        mask: (H, W), the thing's pixels.
        ignored: (H, W), pixels that say nothing, the robot's for example.
    """

    camera: Camera
    mask: NDArray[np.bool_]
    ignored: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryAnswer:
    """How well every Gaussian fits the thing.

    Attributes:
        similarities: (N,) cosine with the thing, or with the way from the rest to it, -1..1.
        threshold: Similarity from which on a Gaussian belongs to the thing.
        iou: Agreement with the prompts' masks of what the Gaussians above it paint there.
        size_m: Size asked for, [m].
    """

    similarities: NDArray[np.float32]
    threshold: float
    iou: float
    size_m: float


def answer_query(
    gaussians: Gaussians,
    affinity: Affinity,
    queries: Sequence[Query],
    width: int,
    within: NDArray[np.bool_] | None = None,
) -> QueryAnswer:
    """Similarity of all Gaussians to a prompted thing, and where to cut.

    Args:
        gaussians: N Gaussians, world frame.
        affinity: Their features.
        queries: The thing in one or more views.
        width: Width at which features are drawn, [px].
        within: (N,), the Gaussians of a larger thing that this one is a part of; None when it
            stands alone.

    Raises:
        ReconstructionError: No query shows anything.
        BackendError: The engine is missing.
    """
    looks = []
    for query in queries:
        sized = measure_masks(gaussians, query.camera, (query.mask & ~query.ignored)[None], width)
        if len(sized.masks):
            looks.append((sized, query))
    if not looks:
        raise ReconstructionError(STAGE, "the prompts show nothing of the scene", "check their boxes")
    size_m = float(np.median([sized.sizes_m[0] for sized, _ in looks]))
    features = affinity.at_size(size_m)
    seen, painted, rest = [], np.zeros(len(gaussians)), np.zeros(len(gaussians))
    for sized, query in looks:
        drawn = render(gaussians, sized.camera, features=features)
        if drawn.features is None:
            raise BackendError("rasterizer", "drew no features", "rebuild the engine")
        mask = sized.masks[0]
        other = ~mask & (drawn.alpha > SOLID_ALPHA) & ~_shrunk(query.ignored, sized.camera)
        seen.append(unit(unit(drawn.features)[mask].mean(0)))
        weights = contribution_weights(gaussians, sized.camera, np.stack([mask, other]).astype(np.float32))
        painted += weights[:, 0]
        rest += weights[:, 1]
    directions = [unit(np.mean(seen, axis=0))]
    if within is not None:
        painted, rest = painted * within, rest * within
        inside, outside = (unit(np.asarray(weights @ features, np.float32)) for weights in (painted, rest))
        directions.append(unit(inside - outside))
    answers = []
    for direction in directions:
        fit = features @ direction
        similarities = fit if within is None else np.where(within, fit, -1).astype(np.float32)
        threshold, iou = best_threshold(similarities, painted, rest)
        answers.append(QueryAnswer(similarities=similarities, threshold=threshold, iou=iou, size_m=size_m))
    return max(answers, key=lambda answer: answer.iou)


def best_threshold(similarities: NDArray[np.float32], inside: Array, outside: Array) -> tuple[float, float]:
    """The cut that agrees best with what was seen, and its IoU; values (N,) above it belong to the thing.

    Where many cuts agree equally well the middle one is taken, as far from the thing as from the rest.

    Args:
        similarities: (N,).
        inside: (N,), how much each value paints of the thing.
        outside: (N,), how much it paints of what is not the thing.
    """
    order = np.argsort(-similarities)
    hits = np.cumsum(inside[order])
    ious = hits / np.maximum(inside.sum() + np.cumsum(outside[order]), 1e-9)
    good = np.flatnonzero(ious >= PLATEAU * ious.max())
    cut = (similarities[order[good[0]]] + similarities[order[good[-1]]]) / 2
    return float(cut), float(ious.max())


def _shrunk(mask: NDArray[np.bool_], camera: Camera) -> NDArray[np.bool_]:
    rows = ((np.arange(camera.height) + 0.5) * mask.shape[0] / camera.height).astype(int)
    columns = ((np.arange(camera.width) + 0.5) * mask.shape[1] / camera.width).astype(int)
    return mask[rows][:, columns]
