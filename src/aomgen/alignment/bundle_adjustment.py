"""Similarity, fixed cameras and clocks in one least-squares problem, from the videos of the arm.

Unknown are a correction of `S_world_recon`, the zero of each arm joint, and for each fixed camera its
pose, the offset and drift of its clock and the bias of its contours. Data are the contours of the arm in the videos
(`silhouette_residuals`) and in scan views (`scan_information`), the place that structure from
motion gave each camera, and hand-eye calibrations. Held-out frames decide whether the
result of a camera is used. Source: Gauss-Newton with Geman and McClure's weights; DESIGN, "Alignment".
"""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.alignment.bundle_equations import (
    DRIFT_SDS,
    FIXED,
    MAX_DRIFT_S,
    MIN_SD_S,
    Block,
    BundleProblem,
    CameraState,
    Columns,
    assemble,
    camera_block,
)
from aomgen.alignment.scan_information import ScanContour, scan_block, trace_scan
from aomgen.alignment.silhouette_fit import move_similarity
from aomgen.alignment.silhouette_residuals import (
    BIAS,
    OFFSET,
    POSE,
    RATE,
    FrameContour,
    trace,
)
from aomgen.core.camera import camera_in_world
from aomgen.core.clock import Clock
from aomgen.core.transforms import invert, matrix_from_rotvec, transform
from aomgen.core.values import Array, freeze

# Search reach and robust kernel of each round of rendering, [px]: from the error of the start down to a
# pixel.
_ROUNDS = ((10, 3.0), (6, 1.5), (4, 1.0))
# Gauss-Newton steps between two renderings, so that the robust weights converge.
_SOLVES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleSolution:
    """Refined similarity, cameras and joint zeros.

    Attributes:
        S_world_recon: (4, 4).
        cameras: With clocks and their standard deviations, by name.
        zeros_rad, zero_sds_rad: What to add to each joint of the log (J,), and standard deviations.
    """

    S_world_recon: Array
    cameras: dict[str, CameraState]
    zeros_rad: Array
    zero_sds_rad: Array

    def __post_init__(self) -> None:
        freeze(self, "S_world_recon", self.S_world_recon, (4, 4))
        freeze(self, "zeros_rad", self.zeros_rad, (None,))
        freeze(self, "zero_sds_rad", self.zero_sds_rad, (len(self.zeros_rad),))


def adjust_bundle(problem: BundleProblem, near: BundleSolution | None = None) -> BundleSolution:
    """Solve for all unknowns; the drift of a clock is kept only where the video determines it.

    A camera without frames is placed by structure and calibration alone.

    Args:
        problem: Data and initial values.
        near: An earlier solution to start from: the search begins with less reach.

    Not checked: that the solution is better than the start; see `silhouette_residuals.misfit`.
    """
    S = problem.S_world_recon if near is None else near.S_world_recon
    states = {
        name: CameraState(camera=camera_in_world(S, item.camera_recon), clock=item.clock)
        for name, item in problem.cameras.items()
    }
    if near is not None:
        states = near.cameras
    zeros = problem.arm.zeros_rad
    columns = Columns(joints=len(zeros), cameras=len(states))
    now = _Solution(columns=columns, S=S, zeros=zeros, states=states, sds=np.zeros(columns.count))
    contours: dict[str, list[FrameContour]] = {}
    scan_contours: list[ScanContour] = []
    for reach, kernel in _ROUNDS[0 if near is None else 1 :]:
        arm = replace(problem.arm, zeros_rad=now.zeros)
        contours = {
            name: trace(
                item.frames, now.states[name].camera, now.states[name].clock, arm, problem.params.points
            )
            for name, item in problem.cameras.items()
        }
        scan_contours = trace_scan(problem.scan, now.S, now.zeros)
        now = _gauss_newton(problem, now, (scan_contours, contours), (reach, kernel), frozenset())
    steady = frozenset(
        name for k, name in enumerate(states) if not _drifts(problem, name, now.clock_of(k, name))
    )
    now = _gauss_newton(problem, now, (scan_contours, contours), (_ROUNDS[-1][0], _ROUNDS[-1][1]), steady)
    return BundleSolution(
        S_world_recon=now.S,
        zeros_rad=now.zeros,
        zero_sds_rad=now.sds[columns.zeros],
        cameras={
            name: replace(
                state, clock=_final_clock(problem, name, now.clock_of(k, name), steady=name in steady)
            )
            for k, (name, state) in enumerate(now.states.items())
        },
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Solution:
    """Current estimate: similarity, joint zeros, cameras, deviations of all unknowns."""

    columns: Columns
    S: Array
    zeros: Array
    states: dict[str, CameraState]
    sds: Array

    def clock_of(self, k: int, name: str) -> Clock:
        sds = self.sds[self.columns.camera(k)]
        return replace(self.states[name].clock, sd_s=float(sds[OFFSET]), rate_sd=float(sds[RATE]))


def _gauss_newton(
    problem: BundleProblem,
    start: _Solution,
    drawn: tuple[list[ScanContour], dict[str, list[FrameContour]]],
    search: tuple[int, float],
    steady: frozenset[str],
) -> _Solution:
    """Take Gauss-Newton steps on contours rendered once; clocks of `steady` cameras do not drift."""
    (scan_contours, contours), columns = drawn, start.columns
    S, zeros, states = start.S, start.zeros, start.states
    for _ in range(_SOLVES):
        blocks = {
            name: camera_block(problem, name, states[name], zeros, contours[name], search) for name in states
        }
        scan = scan_block(problem.scan, scan_contours, S, zeros, search)
        A, b = assemble(problem, scan, blocks, S, zeros, states)
        for k, name in enumerate(states):
            if name in steady:
                at = columns.camera(k).start + RATE
                A[at, at] += FIXED
                b[at] -= FIXED * states[name].clock.rate
        step: Array = np.asarray(np.linalg.solve(A, b), np.float64)
        S = move_similarity(S, step[:7], problem.pivot)
        zeros = zeros + step[columns.zeros]
        states = {
            name: _move_state(states[name], step[columns.camera(k)], problem.pivot)
            for k, name in enumerate(states)
        }
    sds = _standard_deviations(A, b, columns, blocks)
    return _Solution(columns=columns, S=S, zeros=zeros, states=states, sds=sds)


def _drifts(problem: BundleProblem, name: str, clock: Clock) -> bool:
    times = problem.cameras[name].frames.times_s
    return bool(len(times)) and drifts(clock, float(times[-1] - times[0]))


def drifts(clock: Clock, seconds: float) -> bool:
    """Whether a clock's drift matters over so many seconds, and is known well enough to say so."""
    shift = abs(clock.rate) * seconds
    return shift > MAX_DRIFT_S and abs(clock.rate) > DRIFT_SDS * clock.rate_sd


def _final_clock(problem: BundleProblem, name: str, clock: Clock, *, steady: bool) -> Clock:
    given = problem.cameras[name].clock
    if not given.sd_s > 0:
        return given
    return replace(clock, sd_s=max(clock.sd_s, MIN_SD_S), rate=0.0 if steady else clock.rate)


def _move_state(state: CameraState, step: Array, pivot: Array) -> CameraState:
    """After the robot was found to stand `step` away before the camera, and the clock likewise."""
    pose = np.clip(step[POSE], -0.05, 0.05)
    R = matrix_from_rotvec(pose[:3])
    D = transform(R, pivot + pose[3:] - R @ pivot)
    return CameraState(
        camera=state.camera.moved(invert(D) @ state.camera.T_world_cam),
        clock=replace(
            state.clock,
            offset_s=state.clock.offset_s + float(np.clip(step[OFFSET], -0.1, 0.1)),
            rate=state.clock.rate + float(np.clip(step[RATE], -0.02, 0.02)),
        ),
        bias_px=state.bias_px + float(step[BIAS]),
    )


def _standard_deviations(A: Array, b: Array, columns: Columns, blocks: dict[str, Block]) -> Array:
    """Standard deviations of all unknowns: the larger of formal ones and those of a jackknife over time.

    Leaving out segments shows what the formal ones ignore: errors by shadows, occlusion and log noise are
    correlated over many frames.
    """
    formal = np.sqrt(np.diag(np.linalg.inv(A)))
    answers = []
    for k, block in enumerate(blocks.values()):
        at = columns.frames(k)
        for A_left, b_left in block.segments:
            A_rest, b_rest = A.copy(), b.copy()
            A_rest[np.ix_(at, at)] -= A_left
            b_rest[at] -= b_left
            answers.append(np.linalg.solve(A_rest, b_rest))
    if len(answers) < 2:
        return formal
    n = len(answers)
    jackknife = np.sqrt((n - 1) / n * np.sum((np.array(answers) - np.mean(answers, 0)) ** 2, axis=0))
    return np.maximum(formal, jackknife)
