"""Which part every Gaussian belongs to: robot, static part, moving part or background.

Source: AOMGen, sec. 4.1. The robot needs no segmenter: its masks are drawn from the aligned model. The
object's parts come from one labelling of all evidence (`evidence`, `labelling`): boxes fitted to prompts
and masks, the masks themselves, and what the demonstration shows of each Gaussian.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.part_points import SOLID_OPACITY
from aomgen.core.parts import Cut, Parts, no_cut
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError, WrongPromptError
from aomgen.parts.cutting import cut_at_faces
from aomgen.parts.likelihood import (
    LABELS,
    PartEvidence,
    SurfaceView,
    panel_evidence,
    prompted_evidence,
    surface_views,
)
from aomgen.parts.prompted_images import PromptedImage, PromptFit
from aomgen.parts.scan_views import ScanView, spread
from aomgen.parts.smoothing import smooth_posterior

STAGE = "parts"
# Of the robot's surface points and of the panel's search: the same draws in every round, so that rounds differ
# by their evidence alone.
SEED = 0
# Views in which the boxes are drawn to label what they show.
DRAWN_VIEWS = 20
# Fewest Gaussians of a usable part.
MIN_GAUSSIANS = 50
# Parts of one object touch: this share of the moving part's diagonal between them is too much (0.03 on
# captures with right prompts, 0.6 and more with boxes around a neighbor).
MAX_APART_SHARE = 0.2


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
        bodies: (N,) robot bodies, see `label_robot`.
        prompted: Answers to the prompts, see `segment_prompts`.
        given: Evidence of the object's parts by another method than boxes.
    """
    surfaces = [] if given else surface_views(gaussians, spread(views, DRAWN_VIEWS))
    return PromptedScan(
        gaussians=gaussians,
        cut=no_cut(gaussians),
        bodies=bodies,
        prompted=prompted,
        surfaces=surfaces,
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
    """The scan cut where faces of the fitted boxes pass through Gaussians, and evidence of all pieces.

    Args:
        scan: Not cut yet.
        evidence: See `part_evidence`; without boxes nothing is cut.
        motion_log_odds: As they went into the evidence.
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
