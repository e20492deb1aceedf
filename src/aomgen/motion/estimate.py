"""AOMotion: from one demonstration to when, where and how the part moved."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from aomgen.core.joint import Joint
from aomgen.core.motion import MotionCurve, MotionEstimate
from aomgen.core.progress import Progress, silent
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.errors import InputError
from aomgen.io.images import resize
from aomgen.motion.contact import ContactParams, Contacts, find_contacts
from aomgen.motion.demonstration import Demonstration
from aomgen.motion.edges import EdgePrior, edge_prior
from aomgen.motion.filters import smooth
from aomgen.motion.hand import HandSignals, Touch, hand_signals, touch_interval
from aomgen.motion.joint import JointEstimate, JointParams, estimate_joint
from aomgen.motion.keyframes import (
    Interval,
    KeyframeParams,
    find_interval,
    motion_scores,
    part_region,
    reference_count,
)
from aomgen.motion.moved_part import MovedPart, moved_part
from aomgen.motion.theta import (
    LEAVE_M,
    LEAVE_RAD,
    leaving_and_arriving,
    path_values,
    values_at_frames,
)
from aomgen.physics.robot_masks import MasksAt, robot_masks

_DENSE_STEP_S = 0.01
_SMOOTH_S = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionParams:
    """Parameters of the submodules.

    Attributes:
        width: Image width for keyframes, [px].
        max_fps: Faster videos are thinned for keyframes, [1/s].
        agree_s: Largest difference between the interval seen and the one felt, [s].
    """

    keyframes: KeyframeParams = field(default_factory=KeyframeParams)
    contact: ContactParams = field(default_factory=ContactParams)
    joint: JointParams = field(default_factory=JointParams)
    width: int = 320
    max_fps: float = 15.0
    agree_s: float = 0.8


def estimate_motion(
    demonstration: Demonstration, params: MotionParams | None = None, progress: Progress = silent
) -> MotionEstimate:
    """Recover the part's motion.

    Raises:
        WrongPromptError: The hand moved something else than the prompted part.
        NoMotionError: The part does not move in the video.
        DemonstrationTooShortError, AmbiguousJointError: The motion does not tell the joint.
        InputError: A part has hardly any points.

    Source: AOMGen, sec. 4.2, AOMotion.
    """
    params = params or MotionParams()
    demo = demonstration
    for name, points in (("moving", demo.points_moving), ("static", demo.points_static)):
        if not len(points) >= 20:
            raise InputError(f"'{name}' part", f"has {len(points)} points, need 20", "correct its prompts")
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        progress(0.0, "keyframes")
        view = _KeyframeView.of(demo, masks_at, params)
    moved = view.moved_part(demo, params.keyframes)
    moved.check()
    scores, interval = view.interval(params.keyframes)
    progress(0.85, "joint")
    seen = (float(view.signals.times_s[interval.first]), float(view.signals.times_s[interval.last]))
    recovery = _recover(demo, view, seen, params)
    progress(0.95, "joint values")
    curve = MotionCurve(
        times_s=view.signals.times_s,
        scores=scores,
        smoothed=interval.smoothed,
        threshold=interval.threshold,
        distances_m=view.signals.distances_m,
        speeds_m_s=view.signals.speeds_m_s,
        gripper=view.signals.gripper,
    )
    return _assemble(demo, curve, recovery, moved.odds)


@dataclass(frozen=True, slots=True, kw_only=True)
class _KeyframeView:
    """Small frames, robot masks, the part's pixels and the hand at the same times."""

    frames_srgb: NDArray[np.uint8]
    masks: NDArray[np.bool_]
    region: NDArray[np.bool_]
    signals: HandSignals
    touch: Touch

    @staticmethod
    def of(demo: Demonstration, masks_at: MasksAt, params: MotionParams) -> "_KeyframeView":
        stride = max(1, int(np.floor(demo.video.fps / params.max_fps)))
        width = min(params.width, demo.camera.width)
        small = demo.camera.resized(width, round(width * demo.camera.height / demo.camera.width))
        times, offset_s = demo.video.times_s[::stride], demo.clock_offset_s
        signals = hand_signals(demo.robot, demo.log, demo.points_moving, times, offset_s)
        frames = [resize(frame, small.width, small.height) for frame in demo.video.frames_srgb[::stride]]
        return _KeyframeView(
            frames_srgb=np.stack(frames),
            masks=masks_at(times + offset_s, small.width, small.height),
            region=part_region(demo.points_moving, small),
            signals=signals,
            touch=touch_interval(signals),
        )

    def moved_part(self, demo: Demonstration, params: KeyframeParams) -> MovedPart:
        height, width = self.region.shape
        static, other = (
            hand_signals(demo.robot, demo.log, points, self.signals.times_s, demo.clock_offset_s)
            for points in (demo.points_static, demo.points_other)
        )
        return moved_part(
            (demo.points_moving, demo.points_static, demo.points_other),
            (self.signals, static, other),
            self.frames_srgb,
            self.masks,
            demo.camera.resized(width, height),
            params,
        )

    def interval(self, params: KeyframeParams) -> tuple[Array, Interval]:
        count = reference_count(self.signals.times_s, params)
        scores = motion_scores(self.frames_srgb, self.masks, self.region, self.touch, count, params)
        return scores, find_interval(self.signals.times_s, scores, self.touch, params)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Recovery:
    """Joint and values along the touch, with the refined interval."""

    contacts: Contacts
    estimate: JointEstimate
    joint: Joint
    interval: tuple[float, float]
    levels: tuple[float, float]
    times_s: Array
    values: Array
    slip_m: Array


def _recover(
    demo: Demonstration, view: _KeyframeView, seen: tuple[float, float], params: MotionParams
) -> _Recovery:
    """Contact, joint and values, twice: the second round uses the interval that the first one felt."""
    touch, frame_times, offset_s = view.touch, view.signals.times_s, demo.clock_offset_s
    touch_s = (float(frame_times[touch.first]), float(frame_times[touch.last]))
    if not touch.gripped:
        touch_s = (touch_s[0], min(touch_s[1], seen[1] + 0.5))
    interval = seen
    for _ in range(2):
        contacts = find_contacts(
            demo.robot, demo.log, demo.points_moving, interval[0] + offset_s, params.contact
        )
        edges = _edges(demo, contacts, interval, offset_s)
        held = _dense(interval)
        estimate = estimate_joint(_poses(demo, held + offset_s), contacts.grasp_ee, edges, params.joint)
        times = _dense(touch_s)
        reference = int(np.argmin(np.abs(times - interval[0])))
        poses = _poses(demo, times + offset_s)
        path = path_values(estimate.joint, poses, estimate.grasp_ee, reference, edges.face_normal)
        values = smooth(path.values, _DENSE_STEP_S, _SMOOTH_S)
        leave = LEAVE_RAD if estimate.joint.type == "revolute" else LEAVE_M
        felt, levels = leaving_and_arriving(times, values, seen, leave, gripped=touch.gripped)
        interval = (_nearby(felt[0], seen[0], params.agree_s), _nearby(felt[1], seen[1], params.agree_s))
    return _Recovery(
        contacts=contacts,
        estimate=estimate,
        joint=estimate.joint,
        interval=interval,
        levels=levels,
        times_s=times,
        values=values,
        slip_m=path.slip_m,
    )


def _nearby(felt_s: float, seen_s: float, limit_s: float) -> float:
    """The moment felt by the hand, unless the picture contradicts it."""
    return felt_s if abs(felt_s - seen_s) <= limit_s else seen_s


def _edges(
    demo: Demonstration, contacts: Contacts, interval: tuple[float, float], offset_s: float
) -> EdgePrior:
    first_third = interval[0] + np.array([0.0, (interval[1] - interval[0]) / 3]) + offset_s
    begin, later = apply(_poses(demo, first_third), contacts.grasp_ee)
    step = later - begin
    unit = step / max(float(np.linalg.norm(step)), 1e-9)
    return edge_prior(demo.points_static, demo.points_moving, begin, unit)


def _dense(interval: tuple[float, float]) -> Array:
    count = max(2, round((interval[1] - interval[0]) / _DENSE_STEP_S) + 1)
    return np.linspace(interval[0], interval[1], count, dtype=np.float64)


def _poses(demo: Demonstration, log_times_s: Array) -> Array:
    return demo.robot.ee_poses(demo.log.at(log_times_s)[0])


def _assemble(demo: Demonstration, curve: MotionCurve, recovery: _Recovery, odds: float) -> MotionEstimate:
    frames = demo.video.times_s
    estimate = recovery.estimate
    thetas = values_at_frames(frames, recovery.times_s, recovery.values, recovery.interval, recovery.levels)
    moving = (frames >= recovery.interval[0]) & (frames <= recovery.interval[1])
    slip = np.interp(frames, recovery.times_s, recovery.slip_m)
    joint = Joint(
        type=recovery.joint.type,
        axis=recovery.joint.axis,
        origin=recovery.joint.origin,
        lower=0.0,
        upper=float(thetas.max()),
    )
    return MotionEstimate(
        clock_offset_s=demo.clock_offset_s,
        clock_offset_sd_s=demo.clock_sd_s,
        start_s=_first_frame(frames, recovery.interval[0]),
        end_s=_last_frame(frames, recovery.interval[1]),
        curve=curve,
        contacts=recovery.contacts.patches,
        grasp_ee=estimate.grasp_ee,
        joint=joint,
        axis_sd_rad=estimate.axis_sd_rad,
        origin_sd_m=estimate.origin_sd_m,
        type_margin=estimate.margin,
        ee_turn_ratio=estimate.turn_ratio,
        times_s=frames,
        thetas=thetas,
        theta_sd=_theta_sd(demo, recovery, thetas, frames),
        slip_m=np.where(moving, slip, 0.0),
        part_odds=odds,
    )


def _theta_sd(demo: Demonstration, recovery: _Recovery, thetas: Array, frames: Array) -> Array:
    """Path error, axis error and clock error of the values, [rad] or [m]."""
    estimate, joint = recovery.estimate, recovery.joint
    speed = np.abs(np.interp(frames, recovery.times_s, np.gradient(recovery.values, recovery.times_s)))
    clock_part = np.where(thetas > 0, speed, 0.0) * demo.clock_sd_s
    if joint.type == "prismatic":
        return np.sqrt(estimate.residual_m**2 + (thetas * estimate.axis_sd_rad**2 / 2) ** 2 + clock_part**2)
    held = apply(_poses(demo, np.array([recovery.interval[0] + demo.clock_offset_s])), estimate.grasp_ee)[0]
    offset = held - joint.origin
    radius = float(np.linalg.norm(offset - (offset @ joint.axis) * joint.axis))
    path = estimate.residual_m / radius
    axis = estimate.origin_sd_m / radius * 2 * np.abs(np.sin(thetas / 2))
    return np.sqrt(path**2 + axis**2 + clock_part**2)


def _first_frame(frames: Array, moment_s: float) -> float:
    later = frames[frames >= moment_s - 1e-6]
    return float(later[0]) if len(later) else float(frames[-1])


def _last_frame(frames: Array, moment_s: float) -> float:
    earlier = frames[frames <= moment_s + 1e-6]
    return float(earlier[-1]) if len(earlier) else float(frames[0])
