"""Which part every Gaussian belongs to: robot, static part, moving part or background.

Source: AOMGen, sec. 4.1. The robot needs no segmenter: its masks are drawn from the aligned model. The
object's parts are found by one of two methods. "closed_form": a Gaussian takes the label whose masks it
paints most, over the views that were asked (as in FlashSplat, Shen et al., 2024); the masks are drawn
from the panel that explains the prompts, and where none does, the segmenter is asked in more views.
"saga", the paper's: affinity features trained from automatic masks (see `affinity_parts`).
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.conventions import BACKGROUND, MOVING, ROBOT, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.part_points import SOLID_OPACITY
from aomgen.core.progress import Progress, part
from aomgen.core.recording import Prompt
from aomgen.core.values import Array, freeze
from aomgen.errors import ReconstructionError, WrongPromptError
from aomgen.reconstruction.alignment.link_boxes import bodies_in_boxes
from aomgen.reconstruction.alignment.outline_fit import RobotPosture
from aomgen.reconstruction.masks.segmenter import Segmenter
from aomgen.reconstruction.parts.affinity_parts import AffinityPartsParams, affinity_labels, masked_scan
from aomgen.reconstruction.parts.binding import MAX_DISTANCE_M, nearest_links
from aomgen.reconstruction.parts.enclosed import with_enclosed
from aomgen.reconstruction.parts.foot import with_foot
from aomgen.reconstruction.parts.panel_fit import fit_panel
from aomgen.reconstruction.parts.part_masks import ScanView, lift
from aomgen.reconstruction.parts.part_votes import vote_parts
from aomgen.reconstruction.parts.pieces import MIN_WEIGHT
from aomgen.reconstruction.parts.prompted import (
    MAX_MISFIT,
    ObjectLabels,
    PromptedImage,
    ask_prompts,
    surface_seen,
)

STAGE = "parts"
PartsMethod = Literal["closed_form", "saga"]
LOOSE_DISTANCE_M = 0.06
# Boxes explained worse than this (5 % of the box a side) are worth a warning.
DOUBTED_MISFIT = 0.2
# Parts of one object touch: this share of the moving part's diagonal between them is too much (0.03 on
# captures with right prompts, 0.6 and more with boxes around a neighbor).
MAX_APART_SHARE = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class PartsParams:
    """Effort and limits.

    Attributes:
        method: "closed_form" or "saga".
        affinity: Effort of "saga".
        robot: What labels the robot: "links", drawn masks and distance, or "boxes", the paper's way.
        robot_views: Views whose drawn robot masks vote.
        cut_views: Views whose pixels are cut into parts and vote.
        min_gaussians: Fewest Gaussians of a usable part.
        seed: Of the samples on the robot's surface.
    """

    method: PartsMethod = "closed_form"
    affinity: AffinityPartsParams = field(default_factory=AffinityPartsParams)
    robot: Literal["links", "boxes"] = "links"
    robot_views: int = 20
    cut_views: int = 20
    min_gaussians: int = 50
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Parts:
    """Labels of N Gaussians.

    Attributes:
        labels: (N,), see `conventions.PART_LABELS`.
        confidence: (N,), share of the painted weight that agrees, 0 for unseen ones.
        robot_bodies: (N,), index into the robot's `body_names`, -1 where the label is not robot.
        views: Names of the scan images whose part masks were used.
        method: "panel" (a panel explains the prompts), "vote" (masks of more views) or "saga".
        box_misfit: How far the labels' extents are from the prompts' boxes, see `box_misfit`.
    """

    labels: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    robot_bodies: NDArray[np.int32]
    views: tuple[str, ...]
    method: str
    box_misfit: float

    def warnings(self) -> list[str]:
        """Sentences about prompts that the found parts do not fit."""
        if self.box_misfit <= DOUBTED_MISFIT:
            return []
        return [
            f"the parts found end {100 * self.box_misfit / 4:.0f} % of a box away from the prompts' boxes, want "
            f"{100 * DOUBTED_MISFIT / 4:.0f} %; draw boxes that touch each part on all four sides"
        ]

    def __post_init__(self) -> None:
        count = len(self.labels)
        freeze(self, "labels", self.labels, (count,), np.uint8)
        freeze(self, "confidence", self.confidence, (count,), np.float32)
        freeze(self, "robot_bodies", self.robot_bodies, (count,), np.int32)


def find_parts(
    gaussians: Gaussians,
    views: list[ScanView],
    prompts: tuple[Prompt, ...],
    segmenter: Segmenter,
    posture: RobotPosture,
    progress: Progress,
    params: PartsParams | None = None,
) -> Parts:
    """Label all Gaussians.

    Args:
        gaussians: The scan, world frame.
        views: Scan images with drawn robot masks, world frame, held-out ones left out.
        prompts: Of the capture; boxes of "moving" and "static" are used.
        segmenter: Turns boxes into masks.
        posture: Robot as scanned.
        progress: Told about each view.
        params: See `PartsParams`.

    Raises:
        ReconstructionError: A part has no usable prompt, or almost nothing was found of it.
        WrongPromptError: The prompts show parts of different objects.
    """
    params = params or PartsParams()
    rng = np.random.default_rng(params.seed)
    bodies, robot_share = _robot(gaussians, views, posture, params, rng)
    progress(0.25, "robot labelled")
    prompted = ask_prompts(views, prompts, segmenter)
    progress(0.45, "prompts answered")
    if params.method == "saga":
        scan = masked_scan(gaussians, views, prompted, segmenter, part(progress, 0.45, 0.7), params.affinity)
        found = affinity_labels(gaussians, scan, prompted, bodies, part(progress, 0.7, 1.0), params.affinity)
    else:
        found = _by_panel(gaussians, views, prompted, part(progress, 0.45, 0.75), params)
        if found is None or not found.misfit <= MAX_MISFIT:
            voted = vote_parts(gaussians, views, prompted, segmenter, bodies, part(progress, 0.75, 1.0))
            found = voted if found is None else min(found, voted, key=lambda item: item.disagreement)
    labels, confidence = found.labels.copy(), found.confidence.copy()
    robot = bodies >= 0
    labels[robot], confidence[robot] = ROBOT, robot_share[robot]
    _check_touching(gaussians, labels)
    labels = with_enclosed(gaussians.means, gaussians.opacities, labels)
    for name, value in (("static", STATIC), ("moving", MOVING)):
        count = int((labels == value).sum())
        if not count >= params.min_gaussians:
            raise ReconstructionError(
                STAGE,
                f"the {name} part has {count} Gaussians, want {params.min_gaussians}",
                "check its prompts",
            )
    progress(1.0, f"{len(found.views)} views voted")
    return Parts(
        labels=labels,
        confidence=confidence,
        robot_bodies=np.where(labels == ROBOT, bodies, -1),
        views=found.views,
        method=found.method,
        box_misfit=found.misfit,
    )


def _check_touching(gaussians: Gaussians, labels: NDArray[np.uint8]) -> None:
    """Refuse a static part that is nowhere near the moving one."""
    solid = gaussians.opacities > SOLID_OPACITY
    moving, static = (gaussians.means[solid & (labels == value)] for value in (MOVING, STATIC))
    if not (len(moving) and len(static)):
        return
    low, high = np.quantile(moving, [0.02, 0.98], axis=0)
    size = float(np.linalg.norm(high - low))
    gap = float(np.quantile(cKDTree(static).query(moving)[0], 0.05))
    if not gap <= MAX_APART_SHARE * size:
        raise WrongPromptError(
            "prompts of the static part",
            f"what they show is {1e3 * gap:.0f} mm away from the moving part (limit "
            f"{1e3 * MAX_APART_SHARE * size:.0f} mm), so it is another object",
            "in capture.toml, draw 'static' around the body that the moving part hangs on",
        )


def _by_panel(
    gaussians: Gaussians,
    views: list[ScanView],
    prompted: list[PromptedImage],
    progress: Progress,
    params: PartsParams,
) -> ObjectLabels | None:
    """Labels that the panel's masks of many views paint; None when the moving part has no front."""
    try:
        rng = np.random.default_rng(params.seed)
        fit = fit_panel([item.on_surface(gaussians) for item in prompted], rng)
    except ReconstructionError:
        return None
    votes = np.zeros((len(gaussians), 3))
    chosen = views[:: max(1, len(views) // params.cut_views)]
    for index, view in enumerate(chosen):
        seen = fit.panel.labels_seen(surface_seen(gaussians, view.camera, view.robot), view.camera.center)
        rest = (seen == BACKGROUND) & ~view.robot
        votes += lift(gaussians, view, [rest, seen == STATIC, seen == MOVING])
        progress((index + 1) / len(chosen), f"view {index + 1} of {len(chosen)}")
    total = votes.sum(1)
    painted = np.array([BACKGROUND, STATIC, MOVING], np.uint8)[np.argmax(votes, 1)]
    known = total > MIN_WEIGHT
    labels = np.where(known, painted, fit.panel.labels(gaussians.means)).astype(np.uint8)
    labels = with_foot(gaussians, labels, fit.panel, prompted)
    confidence = np.where(known, votes.max(1) / np.maximum(total, 1e-9), 0.0)
    names = tuple(view.name for view in chosen)
    return ObjectLabels.judged(gaussians, prompted, labels, confidence, names, "panel")


def _robot(
    gaussians: Gaussians,
    views: list[ScanView],
    posture: RobotPosture,
    params: PartsParams,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int32], Array]:
    """Bodies (N,) of the robot's Gaussians and the share of their weight inside drawn masks."""
    means = np.asarray(gaussians.means, np.float64)
    if params.robot == "boxes":
        bodies = bodies_in_boxes(means, posture)
        return bodies, (bodies >= 0).astype(np.float64)
    near, distances = nearest_links(means, posture, rng, LOOSE_DISTANCE_M)
    inside, seen = np.zeros(len(gaussians)), np.zeros(len(gaussians))
    for view in views[:: max(1, len(views) // params.robot_views)]:
        weights = lift(gaussians, view, [view.robot, ~view.robot])
        inside += weights[:, 0]
        seen += weights.sum(1)
    share = inside / np.maximum(seen, 1e-9)
    close = (share > 0.5) & (distances < MAX_DISTANCE_M)
    # A Gaussian on a thin finger paints well beyond the finger's outline.
    close |= (share > 0.25) & (distances < 0.5 * MAX_DISTANCE_M)
    # Rims that peep past the outline, and small Gaussians that nearly touch the model, are robot too.
    close |= (distances < 0.3 * MAX_DISTANCE_M) & (gaussians.scales.max(1) < MAX_DISTANCE_M)
    # Mirroring metal is reconstructed behind its surface: what all views see inside the robot is robot.
    behind = (share > 0.85) & (distances < LOOSE_DISTANCE_M)
    # What no view shows lies inside the robot when it is close to its surface.
    robot = (near >= 0) & np.where(seen > 0.05, close | behind, distances < 0.01)
    return np.where(robot, near, -1).astype(np.int32), share
