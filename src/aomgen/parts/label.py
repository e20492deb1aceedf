"""Which part every Gaussian belongs to: robot, static part, moving part or background.

Source: AOMGen, sec. 4.1. The robot needs no segmenter: its masks are drawn from the aligned model. The
object's parts come from one smooth labelling of all evidence: boxes fitted to prompts and masks, the masks
themselves, and what the demonstration shows of each Gaussian. Labels give a motion, and the motion tells which
Gaussians move, in turn.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from aomgen.conventions import BACKGROUND, MOVING, ROBOT, STATIC
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.parts import SOLID_OPACITY, Cut, Parts, no_cut
from aomgen.core.progress import Progress
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError, WrongPromptError
from aomgen.parts.likelihood import (
    LABELS,
    PartEvidence,
    SurfaceView,
    panel_evidence,
    prompted_evidence,
    surface_views,
)
from aomgen.parts.panel import STAGE, cut_at_faces
from aomgen.parts.panel_views import iou
from aomgen.parts.prompted_images import PromptedImage, PromptFit
from aomgen.parts.scan_views import ScanView, spread

# Of the robot's surface points and of the panel's search: the same draws in every round, so that rounds differ
# by their evidence alone.
SEED = 0
# Fewest Gaussians of a usable part.
MIN_GAUSSIANS = 50
# Nothing of an object is so many times farther from its middle than half of it (2 on captures).
FAR = 10
# Parts of one object touch: this share of the moving part's diagonal between them is too much (0.03 on
# captures with right prompts, 0.6 and more with boxes around a neighbor).
MAX_APART_SHARE = 0.2
# Logarithm of how much more likely the demonstration is if a Gaussian (N,) moves than if it stands still, given all
# Gaussians and their labels; None where it tells no motion with these labels.
MotionEvidence = Callable[[Gaussians, NDArray[np.uint8]], Array | None]
# Most rounds, and overlap of the moving part (IoU) from which another round would not change it.
MAX_ROUNDS, SETTLED_IOU = 2, 0.95
# A demonstration that takes more than this share away from the prompted part contradicts the prompts: that is
# for the motion stage to say, with labels as the prompts have them.
MIN_KEPT = 0.5
# Neighbours of a Gaussian in the graph: those around it on a surface.
NEIGHBORS = 10
# Coupling of two touching neighbors of one color, log odds; and the share of it that is left across an edge
# in color.
COUPLING, ACROSS_EDGE = 0.6, 0.2
# Distance over which points are one surface, [m]; and over which colors are one, of 0..1.
REACH_M, COLOR_SD = 0.01, 0.08
# Mean-field iterations: labels can spread over as many neighbourhoods.
ITERATIONS = 30


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptedScan:
    """Segmentation of a scan that does not depend on the demonstration.

    Attributes:
        gaussians: World frame, cut.
        cut: How they were cut.
        bodies: (N,) robot bodies, -1 where a Gaussian is not of the robot.
        prompted: Answers to the prompts.
        surfaces: Views in which boxes are drawn.
        given: Evidence of another method; None for that of boxes.
    """

    gaussians: Gaussians
    cut: Cut
    bodies: NDArray[np.int32]
    prompted: list[PromptedImage]
    surfaces: list[SurfaceView]
    given: PartEvidence | None


def segment_scan(
    gaussians: Gaussians,
    views: list[ScanView],
    bodies: NDArray[np.int32],
    prompted: list[PromptedImage],
    given: PartEvidence | None = None,
) -> PromptedScan:
    """All that is known of the parts without the demonstration.

    Args:
        gaussians: The scan, world frame.
        views: Scan images with drawn robot masks, world frame, held-out ones left out.
        bodies, prompted, given: See `PromptedScan`.
    """
    return PromptedScan(
        gaussians=gaussians,
        cut=no_cut(gaussians),
        bodies=bodies,
        prompted=prompted,
        surfaces=[] if given else surface_views(gaussians, spread(views)),
        given=given,
    )


def part_evidence(scan: PromptedScan, motion_log_odds: Array | None = None) -> PartEvidence:
    """Log-likelihoods of all Gaussians from prompts, masks and the demonstration.

    Args:
        scan: See `segment_scan`.
        motion_log_odds: Natural logarithm of how much more likely the demonstration is if a Gaussian (N,)
            moves than if it stands still; None before the demonstration was looked at.
    """
    evidence = scan.given or prompted_evidence(
        scan.gaussians, scan.prompted, scan.surfaces, np.random.default_rng(SEED), motion_log_odds
    )
    return evidence if motion_log_odds is None else evidence.with_motion(motion_log_odds)


def cut_scan(
    scan: PromptedScan, evidence: PartEvidence, motion_log_odds: Array | None
) -> tuple[PromptedScan, PartEvidence]:
    """The scan cut where faces of the fitted boxes, if any, pass through Gaussians, and evidence of all pieces.

    Args: as they went into `part_evidence`, and what came out.
    """
    if evidence.panel is None:
        return scan, evidence
    cut = cut_at_faces(scan.gaussians, evidence.panel, scan.bodies < 0)
    gaussians, origins = cut.applied(scan.gaussians), cut.origins(len(scan.gaussians))
    known = panel_evidence(gaussians, evidence.panel, scan.surfaces)
    if motion_log_odds is not None:
        known = known.with_motion(motion_log_odds[origins])
    return replace(scan, gaussians=gaussians, cut=cut, bodies=scan.bodies[origins]), known


def find_parts(scan: PromptedScan, evidence: PartEvidence) -> Parts:
    """Label all Gaussians.

    Raises:
        ReconstructionError: Almost nothing was found of a part.
        WrongPromptError: The prompts show parts of different objects.
    """
    gaussians, robot = scan.gaussians, scan.bodies >= 0
    log_likelihoods = evidence.log_likelihoods[~robot]
    colors = np.clip(0.5 + SH_C0 * gaussians.sh[~robot, 0], 0, 1)
    posterior = smooth_posterior(gaussians.means[~robot], colors, log_likelihoods)
    labels = np.full(len(robot), ROBOT, np.uint8)
    labels[~robot] = LABELS[np.argmax(posterior, 1)]
    _check(gaussians, labels)
    labels[_far(gaussians, labels)] = BACKGROUND
    fit = PromptFit.of(gaussians, labels, scan.prompted)
    return Parts(
        labels=labels,
        robot_bodies=np.where(robot, scan.bodies, -1),
        cut=scan.cut,
        method=evidence.method,
        box_misfit=fit.misfit,
        static_agreement=fit.agreement[STATIC],
        moving_agreement=fit.agreement[MOVING],
    )


def _far(gaussians: Gaussians, labels: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Gaussians that the object's pixels show through it, far behind it: sky, as a rule."""
    parts = np.flatnonzero(np.isin(labels, (STATIC, MOVING)))
    means = gaussians.means[parts]
    away = np.linalg.norm(means - np.median(means, 0), axis=1)
    return parts[away > FAR * np.median(away)]


def _check(gaussians: Gaussians, labels: NDArray[np.uint8]) -> None:
    """Refuse parts of which almost nothing was found, and a static part nowhere near the moving one."""
    for name, value in (("static", STATIC), ("moving", MOVING)):
        count = int((labels == value).sum())
        if not count >= MIN_GAUSSIANS:
            raise ReconstructionError(
                STAGE, f"the {name} part has {count} Gaussians, want {MIN_GAUSSIANS}", "check its prompts"
            )
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


def find_moving_parts(scan: PromptedScan, motion_evidence: MotionEvidence, progress: Progress) -> Parts:
    """Label all Gaussians by the prompts and by the demonstration.

    Args:
        scan: Prompts, masks and surfaces.
        motion_evidence: What the demonstration says, given Gaussians, world frame, and their labels.
        progress: Called after each round.

    Raises:
        ReconstructionError, WrongPromptError: See `find_parts`.
    """
    prompted = evidence = part_evidence(scan)
    log_odds = None
    labels = find_parts(scan, prompted).labels
    first = moves = labels == MOVING
    progress(0.3, "boxes fitted to the prompts")
    for round_ in range(MAX_ROUNDS):
        shown = motion_evidence(scan.gaussians, labels)
        if shown is None:
            break
        new_evidence = part_evidence(scan, shown)
        labels = find_parts(scan, new_evidence).labels
        before, moves = moves, labels == MOVING
        if not np.mean(moves[first]) >= MIN_KEPT:
            evidence, log_odds = prompted, None
            break
        evidence, log_odds = new_evidence, shown
        progress(0.3 + 0.6 * (round_ + 1) / MAX_ROUNDS, f"motion in the video, round {round_ + 1}")
        if iou(before, moves) >= SETTLED_IOU:
            break
    return find_parts(*cut_scan(scan, evidence, log_odds))


def smooth_posterior(points: ArrayLike, colors: ArrayLike, log_likelihoods: Array) -> Array:
    """Probability (N, L) of each label at each point.

    Args:
        points: (N, 3), [m].
        colors: (N, 3), 0..1.
        log_likelihoods: (N, L), of all evidence about a point alone.
    """
    coupling = _coupling(np.asarray(points, np.float64), np.asarray(colors, np.float64))
    posterior = _normalize(log_likelihoods)
    for _ in range(ITERATIONS):
        posterior = _normalize(log_likelihoods + coupling @ posterior)
    return posterior


def _coupling(points: Array, colors: Array) -> csr_matrix:
    count = min(NEIGHBORS, len(points) - 1)
    if count < 1:
        return csr_matrix((len(points), len(points)))
    distances, nearest = cKDTree(points).query(points, k=count + 1)
    distances, nearest = distances[:, 1:], nearest[:, 1:]
    contrast = np.linalg.norm(colors[:, None] - colors[nearest], axis=2)
    alike = ACROSS_EDGE + (1 - ACROSS_EDGE) * np.exp(-0.5 * (contrast / COLOR_SD) ** 2)
    weights = COUPLING * alike * np.exp(-0.5 * (distances / REACH_M) ** 2)
    rows = np.repeat(np.arange(len(points)), count)
    one_way = csr_matrix((weights.ravel(), (rows, nearest.ravel())), shape=(len(points), len(points)))
    return csr_matrix((one_way + one_way.T) / 2)


def _normalize(log_weights: Array) -> Array:
    weights = np.exp(log_weights - log_weights.max(1, keepdims=True))
    return np.asarray(weights / weights.sum(1, keepdims=True), np.float64)
