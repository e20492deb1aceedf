"""Similarity, fixed cameras and clocks in one least-squares problem, from the films of the arm.

Unknown are a correction of `S_world_recon`, the zero of each arm joint, and for each fixed camera its
pose, the offset and drift of its clock and the bias of its outlines. Evidence are the outlines of the arm in the films
(`film_outlines`) and in scan views (`scan_information`), the place that structure from
motion gave each camera, and hand-eye calibrations. Frames that had no part in it decide whether a
camera's answer is taken. Source: Gauss-Newton with Geman and McClure's weights; DESIGN, "Alignment".
"""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.alignment.bundle_equations import (
    FIXED,
    Block,
    CameraState,
    Columns,
    JointParams,
    JointProblem,
    assemble,
    camera_block,
)
from aomgen.alignment.scan_information import ScanRim, scan_block, trace_scan
from aomgen.alignment.silhouette_fit import moved_similarity
from aomgen.alignment.silhouette_residuals import (
    BIAS,
    OFFSET,
    POSE,
    RATE,
    Rim,
    trace,
)
from aomgen.core.camera import camera_in_world
from aomgen.core.clock import Clock
from aomgen.core.transforms import invert, matrix_from_rotvec, transform
from aomgen.core.values import Array, freeze

# Search reach and kernel of each drawing, [px]; and solves between two drawings.
_ROUNDS = ((10, 3.0), (6, 1.5), (4, 1.0))
_SOLVES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Refinement:
    """The joint answer.

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


def refine_jointly(problem: JointProblem, near: Refinement | None = None) -> Refinement:
    """Solve; a clock in the answer drifts only where the film says so clearly.

    A camera whose film is empty is placed by structure and calibration alone.

    Args:
        problem: The evidence.
        near: An answer to start from, when there is one: the search begins with less reach.

    Not checked: that the answer is better than the question; see `film_outlines.misfit`.
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
    rims: dict[str, list[Rim]] = {}
    scan_rims: list[ScanRim] = []
    for reach, kernel in _ROUNDS[0 if near is None else 1 :]:
        arm = replace(problem.arm, zeros_rad=now.zeros)
        rims = {
            name: trace(
                item.film, now.states[name].camera, now.states[name].clock, arm, problem.params.points
            )
            for name, item in problem.cameras.items()
        }
        scan_rims = trace_scan(problem.scan, now.S, now.zeros)
        now = _solved(problem, now, (scan_rims, rims), (reach, kernel), frozenset())
    steady = frozenset(
        name for k, name in enumerate(states) if not _drifts(problem, name, now.clock_of(k, name))
    )
    now = _solved(problem, now, (scan_rims, rims), (_ROUNDS[-1][0], _ROUNDS[-1][1]), steady)
    return Refinement(
        S_world_recon=now.S,
        zeros_rad=now.zeros,
        zero_sds_rad=now.sds[columns.zeros],
        cameras={
            name: replace(state, clock=_settled(problem, name, now.clock_of(k, name), steady=name in steady))
            for k, (name, state) in enumerate(now.states.items())
        },
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Solution:
    """Where the search stands: similarity, joint zeros, cameras, deviations of all unknowns."""

    columns: Columns
    S: Array
    zeros: Array
    states: dict[str, CameraState]
    sds: Array

    def clock_of(self, k: int, name: str) -> Clock:
        sds = self.sds[self.columns.camera(k)]
        return replace(self.states[name].clock, sd_s=float(sds[OFFSET]), rate_sd=float(sds[RATE]))


def _solved(
    problem: JointProblem,
    start: _Solution,
    drawn: tuple[list[ScanRim], dict[str, list[Rim]]],
    search: tuple[int, float],
    steady: frozenset[str],
) -> _Solution:
    """Some Gauss-Newton steps on outlines drawn once; clocks of `steady` cameras do not drift."""
    (scan_rims, rims), columns = drawn, start.columns
    S, zeros, states = start.S, start.zeros, start.states
    for _ in range(_SOLVES):
        blocks = {
            name: camera_block(problem, name, states[name], zeros, rims[name], search) for name in states
        }
        scan = scan_block(problem.scan, scan_rims, S, zeros, search)
        A, b = assemble(problem, scan, blocks, S, zeros, states)
        for k, name in enumerate(states):
            if name in steady:
                at = columns.camera(k).start + RATE
                A[at, at] += FIXED
                b[at] -= FIXED * states[name].clock.rate
        step: Array = np.asarray(np.linalg.solve(A, b), np.float64)
        S = moved_similarity(S, step[:7], problem.pivot)
        zeros = zeros + step[columns.zeros]
        states = {
            name: _moved_state(states[name], step[columns.camera(k)], problem.pivot)
            for k, name in enumerate(states)
        }
    sds = _spread(A, b, columns, blocks)
    return _Solution(columns=columns, S=S, zeros=zeros, states=states, sds=sds)


def _drifts(problem: JointProblem, name: str, clock: Clock) -> bool:
    times = problem.cameras[name].film.times_s
    return bool(len(times)) and drifts(clock, float(times[-1] - times[0]), problem.params)


def drifts(clock: Clock, seconds: float, params: JointParams) -> bool:
    """Whether a clock's drift matters over so many seconds, and is known well enough to say so."""
    shift = abs(clock.rate) * seconds
    return shift > params.max_drift_s and abs(clock.rate) > params.drift_sds * clock.rate_sd


def _settled(problem: JointProblem, name: str, clock: Clock, *, steady: bool) -> Clock:
    given = problem.cameras[name].clock
    if not given.sd_s > 0:
        return given
    return replace(clock, sd_s=max(clock.sd_s, problem.params.min_sd_s), rate=0.0 if steady else clock.rate)


def _moved_state(state: CameraState, step: Array, pivot: Array) -> CameraState:
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


def _spread(A: Array, b: Array, columns: Columns, blocks: dict[str, Block]) -> Array:
    """Standard deviations of all unknowns: the larger of formal ones and those over stretches of time.

    Leaving out stretches tells what the formal ones do not know: shadows, hidden hands and log noise
    err alike for many frames.
    """
    formal = np.sqrt(np.diag(np.linalg.inv(A)))
    answers = []
    for k, block in enumerate(blocks.values()):
        at = columns.film(k)
        for A_left, b_left in block.stretches:
            A_rest, b_rest = A.copy(), b.copy()
            A_rest[np.ix_(at, at)] -= A_left
            b_rest[at] -= b_left
            answers.append(np.linalg.solve(A_rest, b_rest))
    if len(answers) < 2:
        return formal
    n = len(answers)
    jackknife = np.sqrt((n - 1) / n * np.sum((np.array(answers) - np.mean(answers, 0)) ** 2, axis=0))
    return np.maximum(formal, jackknife)
