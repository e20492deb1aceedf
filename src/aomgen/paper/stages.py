"""The stages that a project may have done as the paper does them, see `alignment_method` and `motion_method`."""

from pathlib import Path
from typing import Any

import numpy as np

from aomgen.alignment.bundle_terms import BundleParams
from aomgen.alignment.stage import boxes_of, calibrate_cameras, views_of
from aomgen.core.alignment import Alignment
from aomgen.core.motion import MotionEstimate
from aomgen.core.progress import Progress, part
from aomgen.motion.estimate import estimate_motion
from aomgen.motion.stage import OnCurve, motion_input, recover_motion
from aomgen.paper.icp_alignment import align_as_paper
from aomgen.paper.motion_estimate import PaperMotionParams, estimate_motion_paper
from aomgen.paper.true_part_masks import part_masks
from aomgen.results import Results


def run_alignment(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Rigid ICP and link boxes; the paper leaves fixed cameras where the scan has them."""
    return calibrate_cameras(results, align_scan(results), folder, progress, BundleParams(frames=0))


def align_scan(results: Results) -> Alignment:
    """The paper's alignment, see `align_as_paper`."""
    capture, structure = results.pinhole_capture, results.structure
    return align_as_paper(
        views_of(structure, results.scan_images, {}),
        boxes_of(structure, capture.prompts, ("robot",)),
        results.gaussians_recon,
        results.posture_in(capture),
        np.random.default_rng(0),
    )


def run_motion(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """The paper's AOMotion, formulas as printed.

    The paper takes the joint's type as known; here it is the one that our own estimator finds, so both
    have to answer.
    """

    def estimate(results: Results, progress: Progress, on_curve: OnCurve) -> MotionEstimate:
        demonstration = motion_input(results, results.scene, results.parts.labels)
        masks = part_masks(results.capture, results.capture.cameras[0], demonstration)
        ours = estimate_motion(demonstration, None, part(progress, 0.0, 0.7), on_curve)
        params = PaperMotionParams(joint_type=ours.joint.type)
        return estimate_motion_paper(demonstration, masks, params, part(progress, 0.7, 1.0), on_curve)

    return recover_motion(results, folder, progress, estimate)
