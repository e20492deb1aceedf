"""Bundle adjustment of similarity, joint zeros, fixed cameras and clocks, validated on held-out frames."""

from dataclasses import replace

import numpy as np

from aomgen.alignment.arm_contours import NO_FRAMES, misfit, misfits
from aomgen.alignment.bundle_terms import (
    CALIBRATION_SD_M,
    CALIBRATION_SD_RAD,
    KNOWN_SD,
    OFFSET,
    RATE,
    SEGMENT,
    Bundle,
    BundleProblem,
    BundleSolution,
    CameraEvidence,
    CameraState,
    pose_difference,
)
from aomgen.alignment.time_offset import MIN_CLOCK_SD_S
from aomgen.alignment.uncertainty import SIGNIFICANT_SDS, joint_offset_limits, message_unit
from aomgen.core.alignment import Clock
from aomgen.core.camera import camera_in_world
from aomgen.core.least_squares import Kernel, ResidualTerm, jackknife_covariance, solve
from aomgen.core.values import Array
from aomgen.errors import AlignmentError
from aomgen.robots.robot import RobotModel

# Search range and robust kernel of each round of rendering, [px]: from the error of the initial values down to one pixel.
_ROUNDS = ((10, 3.0), (6, 1.5), (4, 1.0))
# Largest number of steps between two renderings, and the relative decrease of the cost at which they end.
_STEPS, _TOLERANCE = 10, 1e-6
# Largest drift that is ignored, as the shift between the two ends of the video, [s]: an error of 20 ms at either end is 6 mm of an
# arm that moves at 0.3 m/s.
_MAX_DRIFT_S = 0.04
# Largest misfit of a video: edges that do not belong to the arm are distributed evenly over the search range, which gives 2/3.
_MAX_MISFIT = 0.5
# Least improvement of held-out frames by joint zeros, in standard errors: chance exceeds it once in forty times. Zeros with an
# error of a quarter of a degree gave 3 to 5 on synthetic captures.
_CLEAR_SDS = 2.0


def adjust_validated(problem: BundleProblem) -> tuple[BundleProblem, BundleSolution]:
    """Solve for cameras and clocks, then for joint zeros; held-out frames decide what is kept.

    A calibration that the result contradicts, or a video whose result is not better than its initial value, is removed from
    the problem, which is then solved again.

    Raises:
        AlignmentError: A joint zero improves the fit, but is larger than that of any calibrated arm.
    """
    while True:
        held = replace(problem, params=replace(problem.params, zero_sd_rad=KNOWN_SD, zero_sd_m=KNOWN_SD))
        found = adjust_bundle(held)
        for name in problem.cameras:
            camera = _without_contradiction(problem, name, found)
            if camera is not None:
                problem = replace(problem, cameras=problem.cameras | {name: camera})
                break
        else:
            return problem, _estimate_joint_zeros(problem, found)


def adjust_bundle(problem: BundleProblem, near: BundleSolution | None = None) -> BundleSolution:
    """Solve for all unknowns; the drift of a clock is kept only if the video determines it.

    The pose of a camera without frames is determined by structure and calibration only.

    Args:
        near: An earlier solution to start from, with a smaller search range.
    """
    x, bundle = near or _start(problem), Bundle(problem)
    terms: list[ResidualTerm[BundleSolution]] = []
    for reach, scale in _ROUNDS[0 if near is None else 1 :]:
        terms = [*bundle.priors(), *bundle.contours(x, reach, Kernel(scale=scale))]
        x = _solve(bundle, terms, x)
    free = [name for name, item in problem.cameras.items() if item.clock.sd_s > 0]
    steady = [name for name in free if not _drifts(problem.cameras[name], x.cameras[name].clock)]
    x = _solve(bundle, [*terms, *(_steady(name) for name in steady)], x)
    cameras = {}
    for name, state in x.cameras.items():
        clock = problem.cameras[name].clock
        if name in free:
            rate = 0.0 if name in steady else state.clock.rate
            clock = replace(state.clock, sd_s=max(state.clock.sd_s, MIN_CLOCK_SD_S), rate=rate)
        cameras[name] = replace(state, clock=clock)
    return replace(x, cameras=cameras)


def drifts(clock: Clock, seconds: float) -> bool:
    """Return whether a clock's drift over a duration is both relevant and significant."""
    shift = abs(clock.rate) * seconds
    return shift > _MAX_DRIFT_S and abs(clock.rate) > SIGNIFICANT_SDS * clock.rate_sd


def _drifts(item: CameraEvidence, clock: Clock) -> bool:
    times = item.frames.times_s
    return bool(len(times)) and drifts(clock, float(times[-1] - times[0]))


def _steady(name: str) -> ResidualTerm[BundleSolution]:
    return ResidualTerm(
        name=f"{name} does not drift",
        residual=lambda x: np.array([x.cameras[name].clock.rate]),
        sd=KNOWN_SD,
    )


def _start(problem: BundleProblem) -> BundleSolution:
    S, zeros = problem.S_world_recon, problem.arm.zeros_rad
    cameras = {
        name: CameraState(camera=camera_in_world(S, item.camera_recon), clock=item.clock)
        for name, item in problem.cameras.items()
    }
    return BundleSolution(
        S_world_recon=S, zeros_rad=zeros, zero_sds_rad=np.zeros_like(zeros), cameras=cameras
    )


def _solve(
    bundle: Bundle, terms: list[ResidualTerm[BundleSolution]], start: BundleSolution
) -> BundleSolution:
    """Minimize the cost; standard deviations are the larger of formal ones and those of a jackknife over time.

    The jackknife includes errors that the formal standard deviations ignore: errors by shadows, occlusion and log noise are
    correlated over many frames.
    """
    found = solve(
        terms,
        start,
        retract=bundle.move,
        dimension=bundle.dimension,
        max_iterations=_STEPS,
        tolerance=_TOLERANCE,
    )
    variances = np.diag(found.covariance)
    segments = [term.name for term in terms if term.name.startswith(SEGMENT)]
    if len(segments) > 1:
        left_out = np.array([found.step_without(name) for name in segments])
        variances = np.maximum(variances, np.diag(jackknife_covariance(left_out)))
    sds, cameras = np.sqrt(variances), {}
    for name, item in found.state.cameras.items():
        own = sds[bundle.first[name] :]
        clock = item.clock
        if bundle.problem.cameras[name].clock.sd_s > 0:
            clock = replace(clock, sd_s=float(own[OFFSET]), rate_sd=float(own[RATE]))
        cameras[name] = replace(item, clock=clock)
    return replace(found.state, zero_sds_rad=sds[bundle.zeros], cameras=cameras)


def _estimate_joint_zeros(problem: BundleProblem, logged: BundleSolution) -> BundleSolution:
    """Add joint zeros to a solution if held-out frames fit clearly better with them."""
    if not any(len(item.held_out.times_s) for item in problem.cameras.values()):
        return logged
    found = adjust_bundle(problem, logged)
    gains = _held_out_misfits(problem, logged) - _held_out_misfits(problem, found)
    gains = gains[~np.isnan(gains)]
    if not (len(gains) > 1 and gains.mean() > _CLEAR_SDS * gains.std(ddof=1) / np.sqrt(len(gains))):
        return logged
    refuse_large_zeros(problem.arm.robot, found)
    return found


def refuse_large_zeros(robot: RobotModel, found: BundleSolution) -> None:
    """Refuse joint zeros that are larger than those of any calibrated arm.

    Raises:
        AlignmentError: Names the joint with the largest zero relative to its limit.
    """
    limits = joint_offset_limits(robot.slides)
    worst = int(np.argmax(np.abs(found.zeros_rad) / limits))
    if abs(found.zeros_rad[worst]) <= limits[worst]:
        return
    factor, unit = message_unit(robot.slides[worst])
    zero, sd, limit = (factor * values[worst] for values in (found.zeros_rad, found.zero_sds_rad, limits))
    raise AlignmentError(
        f"joint '{robot.joint_names[worst]}'",
        f"is {zero:+.1f} {unit} (+-{sd:.1f}) from its logged value according to scan and videos, "
        f"limit {limit:.0f} {unit}",
        "master this joint again, or add its offset to the log",
    )


def _held_out_misfits(problem: BundleProblem, found: BundleSolution) -> Array:
    arm = replace(problem.arm, zeros_rad=found.zeros_rad)
    return np.concatenate(
        [
            misfits(item.held_out, found.cameras[name].camera, found.cameras[name].clock, arm)
            for name, item in problem.cameras.items()
        ]
    )


def _without_contradiction(problem: BundleProblem, name: str, found: BundleSolution) -> CameraEvidence | None:
    """Remove from a camera the calibration or the video that a solution contradicts; None if it contradicts neither."""
    item, state, arm = problem.cameras[name], found.cameras[name], problem.arm
    if item.T_world_cam is not None:
        turn, move = np.split(pose_difference(state.camera, item.T_world_cam), 2)
        if not (
            np.linalg.norm(turn) <= 3 * CALIBRATION_SD_RAD and np.linalg.norm(move) <= 3 * CALIBRATION_SD_M
        ):
            return replace(item, T_world_cam=None)
    if len(item.held_out.times_s):
        start = camera_in_world(problem.S_world_recon, item.camera_recon)
        before = misfit(item.held_out, start, item.clock, arm)
        after = misfit(item.held_out, state.camera, state.clock, arm)
        reason = ""
        if not after < before:
            reason = f"frames left out fit worse than before ({after:.3f}, was {before:.3f})"
        elif not after <= _MAX_MISFIT:
            reason = f"its video does not show the arm's outlines ({after:.2f} off)"
        if reason:
            return replace(
                item, frames=NO_FRAMES, held_out=NO_FRAMES, clock=Clock(offset_s=0.0), rejected=reason
            )
    return None
