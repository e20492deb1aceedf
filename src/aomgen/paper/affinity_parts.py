"""Parts of the object from affinity features: automatic masks, training, one query a part. [paper 4.1]

The prompt's mask in its own view says how large the part is and what its features look like; the similarity
above which a Gaussian belongs to it is the one that paints the prompt's mask best.
Source: SAGA (Cen et al., AAAI 2025), sec. 3.4; there the user sets size and threshold.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress, part
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.paper.affinity_features import (
    Affinity,
    AffinityParams,
    SizedMasks,
    at_resolution,
    measure_masks,
    train_affinity,
    unit,
)
from aomgen.parts.likelihood import PartEvidence
from aomgen.parts.prompted_images import PromptedImage
from aomgen.parts.scan_views import ScanView
from aomgen.splatting.rasterizer import contribution_weights, render

# No feature is surer than this.
LEAST_VOTE = 0.02
# Cosine similarity over which a vote turns from the rest to the part: the width of the logistic step.
SOFTNESS = 0.05
# Cuts this close to the best IoU count as equally good: outlines in masks are no sharper.
PLATEAU = 0.97


def affinity_evidence(
    gaussians: Gaussians,
    views: Sequence[ScanView],
    found: Mapping[str, NDArray[np.bool_]],
    prompted: Sequence[PromptedImage],
    progress: Progress,
    params: AffinityParams,
    rng: np.random.Generator,
) -> PartEvidence:
    """Train and query: log-likelihoods of the object's parts.

    Args:
        found: Masks of some of the views by name, see `segment_views`.

    Raises:
        ReconstructionError: There are no masks, or the prompts show nothing.
    """
    chosen = [view for view in views if view.name in found]
    centers = np.array([view.camera.center for view in chosen])
    # Masks larger than the ring of cameras show the room, not an object in it.
    largest_m = 2 * float(np.linalg.norm(centers.std(axis=0)))
    sized = []
    for view in chosen:
        item = measure_masks(gaussians, view.camera, found[view.name], params.width)
        kept = item.sizes_m <= largest_m
        sized.append(SizedMasks(camera=item.camera, masks=item.masks[kept], sizes_m=item.sizes_m[kept]))
    affinity = train_affinity(gaussians, sized, part(progress, 0.0, 0.95), params, rng)
    static, moving = ([item for item in prompted if item.part == value] for value in (STATIC, MOVING))
    whole, _ = query_part(gaussians, affinity, static, params.width)
    moves = _vote(query_part(gaussians, affinity, moving, params.width, whole > 0)[0])
    # A prompt of the static part shows the whole object, the moving part lies on it.
    stands = _vote(whole) * (1 - moves)
    progress(1.0, "parts queried")
    votes = np.stack([1 - moves - stands, stands, moves], axis=1)
    return PartEvidence(log_likelihoods=np.log(np.maximum(votes, LEAST_VOTE)), method="saga")


def query_part(
    gaussians: Gaussians,
    affinity: Affinity,
    prompted: Sequence[PromptedImage],
    width: int,
    within: NDArray[np.bool_] | None = None,
) -> tuple[Array, float]:
    """Similarity of all Gaussians to a prompted part beyond the threshold for belonging to it.

    A part may be separated from the rest of its object instead: views of the object's other sides
    train what belongs to it, but hardly how far they are from the part. What paints the prompt's mask better
    is taken.

    Args:
        gaussians: N Gaussians, world frame.
        width: Width at which features are drawn, [px].
        within: (N,), the Gaussians of a larger object that contains the part; None when it
            stands alone.

    Returns:
        Cosine similarity (N,) minus the threshold, positive for Gaussians of the part, and the IoU with the
        prompts' masks of what these paint there.

    Raises:
        ReconstructionError: No prompt shows anything.
        BackendError: The engine is missing.
    """
    shown = [
        (item, sized)
        for item in prompted
        if len((sized := measure_masks(gaussians, item.view.camera, item.best_mask[None], width)).masks)
    ]
    if not shown:
        raise ReconstructionError("affinity", "the prompts show nothing of the scene", "check their boxes")
    features = affinity.at_size(float(np.median([sized.sizes_m[0] for _, sized in shown])))
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
    """The cut that agrees best with what was seen, and its IoU; values (N,) above it belong to the part.

    Where many cuts agree equally well the middle one is taken, as far from the part as from the rest.

    Args:
        inside: (N,), how much each value paints of the part.
        outside: (N,), how much it paints of what is not the part.
    """
    order = np.argsort(-similarities)
    hits = np.cumsum(inside[order])
    ious = hits / np.maximum(inside.sum() + np.cumsum(outside[order]), 1e-9)
    good = np.flatnonzero(ious >= PLATEAU * ious.max())
    cut = (similarities[order[good[0]]] + similarities[order[good[-1]]]) / 2
    return float(cut), float(ious.max())


def _vote(margins: Array) -> Array:
    """Probability (N,) of belonging to the part."""
    return 1 / (1 + np.exp(-np.clip(margins / SOFTNESS, -50, 50)))
