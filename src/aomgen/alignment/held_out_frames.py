"""What frames left out of the refinement say of its answer: films, calibrations and joint zeros on trial."""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.alignment.bundle_adjustment import Refinement, refine_jointly
from aomgen.alignment.bundle_equations import JointProblem
from aomgen.alignment.calibration_check import deviation
from aomgen.alignment.silhouette_residuals import Film, misfit, misfits, no_film
from aomgen.core.camera import camera_in_world
from aomgen.core.clock import Clock
from aomgen.core.values import Array
from aomgen.errors import AlignmentError, SyncError

# Edges that have nothing to do with the arm lie anywhere in reach of its outline, at a misfit of 2/3.
_MAX_MISFIT = 0.5
# A joint zero with this deviation is the log's.
_AS_LOGGED_RAD = 1e-6
# Mastered arms are within this.
_MAX_ZERO_RAD = float(np.radians(2.0))
# Standard errors by which left-out frames must be drawn better: right zeros of a quarter of a degree give
# 1.5 to 5, joints that are as logged -1.4 to 0.2; what is wrongly taken is held small by the prior.
_CLEAR_SDS = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Take:
    """One film, cut.

    Attributes:
        film: Frames to learn from; empty when the film cannot be used.
        judges: Frames that judge the answer.
        clock: First guess, or why there is none.
        reason: Why the film cannot be used, or was not believed; empty otherwise.
        calibrated: Whether the hand-eye calibration is leant on.
    """

    film: Film
    judges: Film
    clock: Clock | SyncError
    reason: str
    calibrated: bool


def judge(problem: JointProblem, takes: dict[str, Take]) -> tuple[JointProblem, Refinement, dict[str, Take]]:
    """The refinement, joints as logged, with every film that its left-out frames confirm.

    A calibration that the answer contradicts, or a film whose answer is no better than the question,
    is left out, and the rest is solved again.
    """
    takes, empty = dict(takes), no_film()
    while True:
        held = replace(problem, params=replace(problem.params, zero_sd_rad=_AS_LOGGED_RAD))
        refinement = refine_jointly(held)
        complaint = _complaint(problem, takes, refinement)
        if complaint is None:
            return problem, refinement, takes
        name, reason, calibrated = complaint
        take, camera = takes[name], problem.cameras[name]
        if calibrated:
            takes[name] = replace(take, calibrated=False)
            camera = replace(camera, T_world_cam=None)
        else:
            takes[name] = replace(take, film=empty, judges=empty, reason=reason)
            camera = replace(camera, film=empty, clock=Clock(offset_s=0.0))
        problem = replace(problem, cameras=problem.cameras | {name: camera})


def take_zeros(problem: JointProblem, takes: dict[str, Take], logged: Refinement) -> Refinement:
    """The refinement with joint zeros where frames left out are drawn clearly better with them.

    Raises:
        AlignmentError: They are, and one is larger than any mastered arm's.
    """
    if not any(len(take.judges.times_s) for take in takes.values()):
        return logged
    found = refine_jointly(problem, logged)
    gains = np.concatenate(
        [
            _costs(problem, take, name, logged) - _costs(problem, take, name, found)
            for name, take in takes.items()
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


def _costs(problem: JointProblem, take: Take, name: str, found: Refinement) -> Array:
    state = found.cameras[name]
    return misfits(take.judges, state.camera, state.clock, replace(problem.arm, zeros_rad=found.zeros_rad))


def _complaint(
    problem: JointProblem, takes: dict[str, Take], refinement: Refinement
) -> tuple[str, str, bool] | None:
    """The first camera that has to be solved without something: name, reason, whether calibration."""
    for name, take in takes.items():
        camera, state = problem.cameras[name], refinement.cameras[name]
        if camera.T_world_cam is not None and not deviation(camera.T_world_cam, state.camera).within(
            3 * problem.params.calibration_sd_m, 3 * problem.params.calibration_sd_rad
        ):
            return name, "", True
        if len(take.judges.times_s) and isinstance(take.clock, Clock):
            start = camera_in_world(problem.S_world_recon, camera.camera_recon)
            before = misfit(take.judges, start, take.clock, problem.arm)
            after = misfit(take.judges, state.camera, state.clock, problem.arm)
            if not after < before:
                return name, f"frames left out fit worse than before ({after:.3f}, was {before:.3f})", False
            if not after <= _MAX_MISFIT:
                return name, f"its film does not show the arm's outlines ({after:.2f} off)", False
    return None
