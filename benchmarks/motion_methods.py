"""The paper's motion recovery and ours, on a finished run."""

from typing import Any, get_args

import numpy as np

from aomgen.core.joint import JointType
from aomgen.errors import EstimationError
from aomgen.motion.estimates_file import NO_MOTION, motion_estimates
from aomgen.motion.inputs import MotionInput
from aomgen.motion.stage import motion_input
from aomgen.paper.mask_keyframes import PartMasks, Variant
from aomgen.paper.motion_estimate import estimate_motion_paper
from aomgen.results import Results
from benchmarks.accuracy import score_motion
from benchmarks.images import TrueMasks
from benchmarks.segmented import segmented
from benchmarks.table import as_table
from benchmarks.truth import Truth

PREFIX = "paper_motion."
# Metrics in which the methods are compared.
GROUPS = ("keyframes.", "contact_mm", "joint.", "theta.")
REFUSAL = "refusal"
# The second one shows the effect of the printed signs where the printed threshold refuses.
VARIANTS = get_args(Variant)


def paper_estimates(
    demonstration: MotionInput, masks: PartMasks, joint_type: JointType
) -> dict[str, dict[str, Any]]:
    """Compute each variant's entries of estimates.json; refused ones have the reason under "refusal"."""
    answers = {}
    for name in VARIANTS:
        try:
            answers[name] = motion_estimates(estimate_motion_paper(demonstration, masks, joint_type, name))
        except EstimationError as error:
            answers[name] = NO_MOTION | {REFUSAL: str(error)}
    return answers


def paper_motion_figures(results: Results, truth: Truth, masks: TrueMasks) -> dict[str, Any]:
    """Compute metrics of the paper's motion recovery on a finished run, under separate names.

    The paper's method is given masks and joint type: masks are the true ones with a segmenter's
    errors, the type is the true one.

    Args:
        results: Results of a run that is finished up to its motion.
        truth: Truth of the capture.
        masks: True masks of the first camera's video.
    """
    demonstration = motion_input(results, results.scene, results.parts.labels)
    times_s = demonstration.video.times_s
    labels = np.stack([masks.read(f"{k:04d}") for k in range(len(times_s))])
    given = segmented(labels, np.random.default_rng(0))
    figures = {}
    for name, answer in paper_estimates(demonstration, given, truth.joint.type).items():
        kept = score_motion(answer, truth, times_s, masks.folder.name)
        kept[REFUSAL] = answer.get(REFUSAL)
        figures |= {f"{PREFIX}{name}.{key}": value for key, value in kept.items()}
    return figures


def motion_methods_table(figures: dict[str, Any]) -> str:
    """Format one row per metric, a column for our estimator and for each variant of the paper's."""
    names = [name for name in figures if name.startswith(GROUPS)]
    rows = [
        {"figure": name, "aomotion": figures[name]}
        | {variant: figures.get(f"{PREFIX}{variant}.{name}") for variant in VARIANTS}
        for name in names
    ]
    return as_table(rows)
