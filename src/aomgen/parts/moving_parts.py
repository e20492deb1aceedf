"""Parts and motion in turn: labels give a motion, and the motion tells which Gaussians move."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING
from aomgen.core.gaussians import Gaussians
from aomgen.core.parts import Parts
from aomgen.core.progress import Progress
from aomgen.core.values import Array
from aomgen.parts.label import PromptedScan, cut_scan, find_parts, part_evidence

# Logarithm of how much more likely the demonstration is if a Gaussian (N,) moves than if it stands still, given all
# Gaussians and their labels; None where it tells no motion with these labels.
MotionEvidence = Callable[[Gaussians, NDArray[np.uint8]], Array | None]
# Most rounds, and overlap of the moving part (IoU) from which another round would not change it.
MAX_ROUNDS, SETTLED_IOU = 2, 0.95
# A demonstration that takes more than this share away from the prompted part contradicts the prompts: that is
# for the motion stage to say, with labels as the prompts have them.
MIN_KEPT = 0.5


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
    first = current = find_parts(scan, prompted)
    progress(0.3, "boxes fitted to the prompts")
    for round_ in range(MAX_ROUNDS):
        shown = motion_evidence(scan.gaussians, current.labels)
        if shown is None:
            break
        new_evidence = part_evidence(scan, shown)
        found = find_parts(scan, new_evidence)
        if not _kept(first.labels, found.labels) >= MIN_KEPT:
            evidence, log_odds = prompted, None
            break
        before, current = current, found
        evidence, log_odds = new_evidence, shown
        progress(0.3 + 0.6 * (round_ + 1) / MAX_ROUNDS, f"demonstration looked at, round {round_ + 1}")
        if _iou(before.labels, current.labels) >= SETTLED_IOU:
            break
    return find_parts(*cut_scan(scan, evidence, log_odds))


def _iou(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """Overlap of the moving parts of two labellings (N,)."""
    either = np.sum((first == MOVING) | (second == MOVING))
    return float(np.sum((first == MOVING) & (second == MOVING)) / max(1, either))


def _kept(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """Share of the first labelling's moving part that moves in the second one too."""
    return float(np.mean(second[first == MOVING] == MOVING))
