"""Labels of all Gaussians: robot, static part, moving part or background.

Source: AOMGen, sec. 4.1. The robot needs no segmenter: its masks are rendered from the aligned model. The
parts of the object are one smooth labeling by all evidence: boxes fitted to prompts and masks, the masks, and the motion of each
Gaussian in the demonstration. Labels and motion are estimated alternately.
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
from aomgen.parts.likelihood import LABELS, PartEvidence, ViewSurface, weigh_panel, weigh_prompts
from aomgen.parts.panel import STAGE, cut_at_faces
from aomgen.parts.panel_terms import iou
from aomgen.parts.prompted_images import PromptedImage, compare_with_prompts, find_surface
from aomgen.parts.scan_views import ScanView, spread

# Seed of the robot's surface samples and of the panel's search: equal in every round, so that the rounds differ only in their
# evidence.
SEED = 0
# Least number of Gaussians of a usable part.
MIN_GAUSSIANS = 50
# Gaussians farther from the object's center than this multiple of the median distance do not belong to it (2 on captures).
FAR = 10
# Largest distance between the parts of one object, as a share of the moving part's diagonal (0.03 on captures with correct prompts,
# 0.6 and more with boxes around a neighboring object).
MAX_APART_SHARE = 0.2
# Log-likelihood ratio (N,) of the demonstration if a Gaussian moves to that if it rests, given all Gaussians and their
# labels; None where no motion is found with these labels.
MotionEvidence = Callable[[Gaussians, NDArray[np.uint8]], Array | None]
# Largest number of rounds, and overlap (IoU) of the moving part in two rounds at which the iteration has converged.
MAX_ROUNDS, SETTLED_IOU = 2, 0.95
# Least share of the prompted part in the result; with less, the demonstration contradicts the prompts. The motion stage reports
# this and needs the labels of the prompts.
MIN_KEPT = 0.5
# Neighbors of a Gaussian in the graph: those around it on a surface.
NEIGHBORS = 10
# Coupling of two touching neighbors of one color, a log-likelihood ratio; and its share that is left across an edge
# in color.
COUPLING, ACROSS_EDGE = 0.6, 0.2
# Distance within which points belong to one surface, [m], and difference within which colors are equal, of 0..1.
REACH_M, COLOR_SD = 0.01, 0.08
# Number of mean-field iterations: labels can spread over this number of neighborhoods.
ITERATIONS = 30


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptedScan:
    """Segmentation of a scan that does not depend on the demonstration.

    Attributes:
        gaussians: World frame, cut.
        cut: Gaussians of the scan that were cut.
        bodies: (N,) robot bodies, -1 for Gaussians that do not belong to the robot.
        prompted: Segmented prompts.
        surfaces: Views in which boxes are rendered.
        given: Evidence of another method; None for the evidence of boxes.
    """

    gaussians: Gaussians
    cut: Cut
    bodies: NDArray[np.int32]
    prompted: list[PromptedImage]
    surfaces: list[ViewSurface]
    given: PartEvidence | None


def segment_scan(
    gaussians: Gaussians,
    views: list[ScanView],
    bodies: NDArray[np.int32],
    prompted: list[PromptedImage],
    given: PartEvidence | None = None,
) -> PromptedScan:
    """Collect the evidence of the parts without the demonstration.

    Args:
        gaussians: The scan, world frame.
        views: Scan images with rendered robot masks, world frame, without held-out ones.
        bodies, prompted, given: See `PromptedScan`.
    """
    shown = [] if given else spread(views)
    return PromptedScan(
        gaussians=gaussians,
        cut=no_cut(gaussians),
        bodies=bodies,
        prompted=prompted,
        surfaces=[(view, find_surface(gaussians, view)) for view in shown],
        given=given,
    )


def weigh_evidence(scan: PromptedScan, motion_log_ratios: Array | None = None) -> PartEvidence:
    """Compute log-likelihoods of all Gaussians from prompts, masks and the demonstration.

    Args:
        scan: See `segment_scan`.
        motion_log_ratios: See `MotionEvidence`; None before the motion is estimated.
    """
    evidence = scan.given or weigh_prompts(
        scan.gaussians, scan.prompted, scan.surfaces, np.random.default_rng(SEED), motion_log_ratios
    )
    return evidence if motion_log_ratios is None else evidence.add_motion(motion_log_ratios)


def cut_scan(
    scan: PromptedScan, evidence: PartEvidence, motion_log_ratios: Array | None
) -> tuple[PromptedScan, PartEvidence]:
    """Cut the scan where faces of the fitted boxes, if any, intersect Gaussians, and weigh the evidence of the pieces.

    Args:
        scan, motion_log_ratios: See `weigh_evidence`.
        evidence: Its result.
    """
    if evidence.panel is None:
        return scan, evidence
    cut = cut_at_faces(scan.gaussians, evidence.panel, scan.bodies < 0)
    gaussians, origins = cut.apply(scan.gaussians), cut.origins(len(scan.gaussians))
    weighed = weigh_panel(gaussians, evidence.panel, scan.surfaces)
    if motion_log_ratios is not None:
        weighed = weighed.add_motion(motion_log_ratios[origins])
    return replace(scan, gaussians=gaussians, cut=cut, bodies=scan.bodies[origins]), weighed


def find_parts(scan: PromptedScan, evidence: PartEvidence) -> Parts:
    """Label all Gaussians.

    Raises:
        ReconstructionError: A part has almost no Gaussians.
        WrongPromptError: The prompts show parts of different objects.
    """
    gaussians, robot = scan.gaussians, scan.bodies >= 0
    log_likelihoods = evidence.log_likelihoods[~robot]
    colors = np.clip(0.5 + SH_C0 * gaussians.sh[~robot, 0], 0, 1)
    posterior = smooth_posterior(gaussians.means[~robot], colors, log_likelihoods)
    labels = np.full(len(robot), ROBOT, np.uint8)
    labels[~robot] = LABELS[np.argmax(posterior, 1)]
    _check(gaussians, labels)
    labels[_find_far(gaussians, labels)] = BACKGROUND
    misfit, agreement = compare_with_prompts(gaussians, labels, scan.prompted)
    return Parts(
        labels=labels,
        robot_bodies=np.where(robot, scan.bodies, -1),
        cut=scan.cut,
        method=evidence.method,
        box_misfit=misfit,
        static_agreement=agreement[STATIC],
        moving_agreement=agreement[MOVING],
    )


def _find_far(gaussians: Gaussians, labels: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Find Gaussians far behind the object that are visible through it: mostly sky."""
    parts = np.flatnonzero(np.isin(labels, (STATIC, MOVING)))
    means = gaussians.means[parts]
    away = np.linalg.norm(means - np.median(means, 0), axis=1)
    return parts[away > FAR * np.median(away)]


def _check(gaussians: Gaussians, labels: NDArray[np.uint8]) -> None:
    """Refuse parts with almost no Gaussians, and a static part far away from the moving one."""
    for name, value in (("static", STATIC), ("moving", MOVING)):
        count = int((labels == value).sum())
        if not count >= MIN_GAUSSIANS:
            raise ReconstructionError(
                STAGE, f"the {name} part has {count} Gaussians, expected {MIN_GAUSSIANS}", "check its prompts"
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
            f"it is {1e3 * gap:.0f} mm away from the moving part (limit "
            f"{1e3 * MAX_APART_SHARE * size:.0f} mm), so it is another object",
            "in capture.toml, draw 'static' around the body that the moving part hangs on",
        )


def find_moving_parts(scan: PromptedScan, motion_evidence: MotionEvidence, progress: Progress) -> Parts:
    """Label all Gaussians by the prompts and by the demonstration.

    Args:
        scan: Prompts, masks and surfaces.
        motion_evidence: Evaluates the demonstration for Gaussians, world frame, and their labels.
        progress: Called after each round.

    Raises:
        ReconstructionError, WrongPromptError: See `find_parts`.
    """
    prompted = evidence = weigh_evidence(scan)
    log_ratios = None
    labels = find_parts(scan, prompted).labels
    first = moves = labels == MOVING
    progress(0.3, "boxes fitted to the prompts")
    for round_ in range(MAX_ROUNDS):
        observed = motion_evidence(scan.gaussians, labels)
        if observed is None:
            break
        new_evidence = weigh_evidence(scan, observed)
        labels = find_parts(scan, new_evidence).labels
        before, moves = moves, labels == MOVING
        if not np.mean(moves[first]) >= MIN_KEPT:
            evidence, log_ratios = prompted, None
            break
        evidence, log_ratios = new_evidence, observed
        progress(0.3 + 0.6 * (round_ + 1) / MAX_ROUNDS, f"motion in the video, round {round_ + 1}")
        if iou(before, moves) >= SETTLED_IOU:
            break
    return find_parts(*cut_scan(scan, evidence, log_ratios))


def smooth_posterior(points: ArrayLike, colors: ArrayLike, log_likelihoods: Array) -> Array:
    """Compute the probability (N, L) of each label at each point, by mean-field iterations.

    Args:
        points: (N, 3), [m].
        colors: (N, 3), 0..1.
        log_likelihoods: (N, L), of the evidence about each single point.
    """
    coupling = _couple(np.asarray(points, np.float64), np.asarray(colors, np.float64))
    posterior = _normalize(log_likelihoods)
    for _ in range(ITERATIONS):
        posterior = _normalize(log_likelihoods + coupling @ posterior)
    return posterior


def _couple(points: Array, colors: Array) -> csr_matrix:
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
