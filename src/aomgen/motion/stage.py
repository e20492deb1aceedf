"""Motion stage: interval, contact, joint and joint values. [paper 4.2]"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.core.gaussians import Gaussians
from aomgen.core.motion import MotionCurve, MotionEstimate
from aomgen.core.progress import Progress
from aomgen.core.values import Array
from aomgen.errors import EstimationError
from aomgen.io.artifact import save_artifact
from aomgen.io.atomic import write_json
from aomgen.motion.estimate import MotionParams, OnCurve, estimate_motion, first_motion
from aomgen.motion.estimates_file import ESTIMATES, REFUSED_MOTION, describe_estimates
from aomgen.motion.inputs import MotionInput
from aomgen.motion.motion_detection import list_warnings
from aomgen.motion.part_tracking import compute_log_likelihood_ratio
from aomgen.results import Results


def run(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Recover the motion, see `recover_motion`."""

    def estimate(results: Results, progress: Progress, on_curve: OnCurve) -> MotionEstimate:
        demonstration = motion_input(results, results.scene, results.parts.labels)
        params = results.params("motion", MotionParams())
        return estimate_motion(demonstration, params, progress, on_curve)

    return recover_motion(results, folder, progress, estimate)


def recover_motion(
    results: Results,
    folder: Path,
    progress: Progress,
    estimate: Callable[[Results, Progress, OnCurve], MotionEstimate],
) -> dict[str, Any]:
    """Write the result of a motion estimator to the run's results, and `estimates.json`.

    A refused motion is recorded as refused before the error is raised again, together with its score.
    """
    curves: list[MotionCurve] = []
    try:
        motion = estimate(results, progress, curves.append)
    except EstimationError as error:
        if curves:
            save_artifact(results.out, REFUSED_MOTION, curves[-1])
        refusals = [{"quantity": "motion", "reason": str(error)}]
        write_json(results.out / ESTIMATES, describe_estimates(results, None, refusals))
        raise
    save_artifact(folder, "motion", motion)
    write_json(results.out / ESTIMATES, describe_estimates(results, motion, []))
    unit = "deg" if motion.joint.type == "revolute" else "mm"
    factor = 180 / np.pi if unit == "deg" else 1e3
    return {
        "clock_offset_s": motion.clock_offset_s,
        "start_s": motion.start_s,
        "end_s": motion.end_s,
        "joint": motion.joint.type,
        "direction": motion.direction,
        f"moved_{unit}": factor * float(motion.thetas.max()),
        "axis_ci95_deg": float(np.degrees(motion.axis_ci95_rad)),
        "origin_ci95_mm": 1e3 * motion.origin_ci95_m,
        "part_odds": motion.part_odds,
        "warnings": list_warnings(motion.part_odds),
    }


def motion_input(results: Results, scene: Gaussians, labels: NDArray[np.uint8]) -> MotionInput:
    """Read the inputs of AOMotion from a run that is finished up to its alignment.

    These are the first fixed camera's video, the log, and the scan, world frame, with a
    label of every Gaussian.

    Raises:
        SyncError: The clock offset is unknown.
    """
    return MotionInput(
        video=results.videos[results.demo_camera],
        camera=results.fixed_camera.camera,
        log=results.demo_log,
        robot=results.robot,
        scene=scene,
        labels=labels,
        clock=results.fixed_camera.require_clock(),
    )


def motion_evidence(results: Results, scene: Gaussians, labels: NDArray[np.uint8]) -> Array | None:
    """Compute the log-likelihood ratio (N,) of a moving over a resting Gaussian.

    Returns:
        Natural logarithms; None where the demonstration shows no motion with these labels. The motion
        stage then raises the same error with its reason.
    """
    demonstration = motion_input(results, scene, labels)
    try:
        return compute_log_likelihood_ratio(demonstration, first_motion(demonstration))
    except EstimationError:
        return None
