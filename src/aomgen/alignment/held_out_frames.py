"""Validation of the bundle adjustment on held-out frames: videos, calibrations and joint zeros."""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.alignment.bundle_adjustment import BundleSolution, adjust_bundle
from aomgen.alignment.bundle_equations import CALIBRATION_SD_M, CALIBRATION_SD_RAD, BundleProblem
from aomgen.alignment.calibration_check import deviation
from aomgen.alignment.silhouette_residuals import GrayFrames, empty_frames, misfit, misfits
from aomgen.core.camera import camera_in_world
from aomgen.core.clock import Clock
from aomgen.core.values import Array
from aomgen.errors import AlignmentError, SyncError

# Edges unrelated to the arm lie anywhere in reach of its contour, which gives a misfit of 2/3.
_MAX_MISFIT = 0.5
# Prior deviation that fixes the joint zeros to the log, [rad].
_AS_LOGGED_RAD = 1e-6
# Joint zeros of mastered arms are below this, [rad].
_MAX_ZERO_RAD = float(np.radians(2.0))
# Standard errors by which held-out frames must fit better: right zeros of a quarter of a degree give
# 1.5 to 5, joints that are as logged -1.4 to 0.2; what is wrongly taken is held small by the prior.
_CLEAR_SDS = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutSplit:
    """Frames of one video, split into those to fit and those held out.

    Attributes:
        frames: Frames to fit; empty when the video cannot be used.
        held_out: Frames that validate the result.
        clock: First guess, or why there is none.
        reason: Why the video cannot be used, or was rejected; empty otherwise.
        calibrated: Whether the hand-eye calibration is used.
    """

    frames: GrayFrames
    held_out: GrayFrames
    clock: Clock | SyncError
    reason: str
    calibrated: bool


def reject_unconfirmed(
    problem: BundleProblem, splits: dict[str, HeldOutSplit]
) -> tuple[BundleProblem, BundleSolution, dict[str, HeldOutSplit]]:
    """Refine with the joints as logged and drop every video that its held-out frames do not confirm.

    A calibration that the result contradicts, or a video whose result is no better than its start,
    is left out, and the rest is solved again.
    """
    splits, empty = dict(splits), empty_frames()
    while True:
        held = replace(problem, params=replace(problem.params, zero_sd_rad=_AS_LOGGED_RAD))
        refinement = adjust_bundle(held)
        contradiction = _first_contradiction(problem, splits, refinement)
        if contradiction is None:
            return problem, refinement, splits
        name, reason, calibrated = contradiction
        split, camera = splits[name], problem.cameras[name]
        if calibrated:
            splits[name] = replace(split, calibrated=False)
            camera = replace(camera, T_world_cam=None)
        else:
            splits[name] = replace(split, frames=empty, held_out=empty, reason=reason)
            camera = replace(camera, frames=empty, clock=Clock(offset_s=0.0))
        problem = replace(problem, cameras=problem.cameras | {name: camera})


def estimate_joint_zeros(
    problem: BundleProblem, splits: dict[str, HeldOutSplit], logged: BundleSolution
) -> BundleSolution:
    """Add joint zeros to the refinement if held-out frames fit clearly better with them.

    Raises:
        AlignmentError: They do, and one is larger than on any mastered arm.
    """
    if not any(len(split.held_out.times_s) for split in splits.values()):
        return logged
    found = adjust_bundle(problem, logged)
    gains = np.concatenate(
        [
            _costs(problem, split, name, logged) - _costs(problem, split, name, found)
            for name, split in splits.items()
        ]
    )
    gains = gains[~np.isnan(gains)]
    if not (len(gains) > 1 and gains.mean() > _CLEAR_SDS * gains.std(ddof=1) / np.sqrt(len(gains))):
        return logged
    worst = int(np.argmax(np.abs(found.zeros_rad)))
    if not abs(found.zeros_rad[worst]) <= _MAX_ZERO_RAD:
        raise AlignmentError(
            f"joint '{problem.arm.log.joint_names[worst]}'",
            f"is {np.degrees(found.zeros_rad[worst]):+.1f} deg (+-{np.degrees(found.zero_sds_rad[worst]):.1f}) "
            f"from where the log has it, scan and videos say; limit {np.degrees(_MAX_ZERO_RAD):.0f} deg",
            "master this joint again, or add its offset to the log",
        )
    return found


def _costs(problem: BundleProblem, split: HeldOutSplit, name: str, found: BundleSolution) -> Array:
    state = found.cameras[name]
    return misfits(split.held_out, state.camera, state.clock, replace(problem.arm, zeros_rad=found.zeros_rad))


def _first_contradiction(
    problem: BundleProblem, splits: dict[str, HeldOutSplit], refinement: BundleSolution
) -> tuple[str, str, bool] | None:
    """The first camera that has to be solved without something: name, reason, whether calibration."""
    for name, split in splits.items():
        camera, state = problem.cameras[name], refinement.cameras[name]
        if camera.T_world_cam is not None and not deviation(camera.T_world_cam, state.camera).within(
            3 * CALIBRATION_SD_M, 3 * CALIBRATION_SD_RAD
        ):
            return name, "", True
        if len(split.held_out.times_s) and isinstance(split.clock, Clock):
            start = camera_in_world(problem.S_world_recon, camera.camera_recon)
            before = misfit(split.held_out, start, split.clock, problem.arm)
            after = misfit(split.held_out, state.camera, state.clock, problem.arm)
            if not after < before:
                return name, f"frames left out fit worse than before ({after:.3f}, was {before:.3f})", False
            if not after <= _MAX_MISFIT:
                return name, f"its film does not show the arm's outlines ({after:.2f} off)", False
    return None
