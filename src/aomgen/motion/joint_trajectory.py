"""Contact, joint and joint values from the hand's path during the touch."""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.core.joint import JointType
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.motion.axis_prior import PartShape, measure_shape
from aomgen.motion.contact import SURFACE_SD_M, WINDOW_S, Contacts, carry_part, find_contacts
from aomgen.motion.ee_path import GraspGuess
from aomgen.motion.inputs import MotionInput
from aomgen.motion.joint_estimation import JointCandidates, JointEstimate, JointParams, fit_candidates
from aomgen.motion.joint_value import (
    TouchObservation,
    ValueTrajectory,
    compute_path_values,
    find_motion_tolerance,
    follow_pushed_part,
    refine_interval,
    select_resting,
    smooth_within,
)
from aomgen.motion.keyframes import Departures, Interval
from aomgen.motion.observations import VideoObservations
from aomgen.motion.onset import Detectability
from aomgen.motion.params import MotionParams

# Step at which joint values are computed, [s]: that of a 100 Hz joint log.
_DENSE_STEP_S = 0.01
# Width of the smoother of joint values, [s]; short against any commanded motion.
_SMOOTH_S = 0.2
# Largest difference between a moment seen in the video and the one that the hand tells, [s].
_AGREE_S = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoveredMotion:
    """Joint and values along the touch, with the refined interval.

    Attributes:
        contacts: By the refined interval.
        found, estimate: What the hand's path says, and of the type that is recovered.
        trajectory: Values along the touch.
        level_sd: Standard deviation of its first level beyond that of the hand's path, [rad] or [m].
        face_normal: Outward normal of the part's face (3,) at value 0.
    """

    contacts: Contacts
    found: JointCandidates
    estimate: JointEstimate
    trajectory: ValueTrajectory
    level_sd: float
    face_normal: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoveryInput:
    """What a recovery starts from, whichever type the joint is of.

    Attributes:
        demo: Video, log and scan.
        seen: Start and end as seen in the picture, [s].
        touch_s: First and last moment at which the hand can move the part, [s].
        gripped: The hand held the part before and after.
        joint: How the hand's way is read.
        shape: Of the parts.
        surface: Points of the moving part (N, 3), world frame, [m].
        contacts, found: By the interval seen.
        picture: What the video shows of start and end.
    """

    demo: MotionInput
    seen: tuple[float, float]
    touch_s: tuple[float, float]
    gripped: bool
    joint: JointParams
    shape: PartShape
    surface: Array
    contacts: Contacts
    found: JointCandidates
    picture: TouchObservation


def prepare_recovery(
    demo: MotionInput,
    view: VideoObservations,
    departures: Departures,
    interval: Interval,
    params: MotionParams,
) -> RecoveryInput:
    """Contact, and either type's joint, by the interval seen and the departures that it was read from.

    Raises:
        DemonstrationTooShortError: The hand moved the part less than 3 cm.
    """
    seen = (interval.start.time_s, interval.end.time_s)
    touch, frame_times = view.touch, view.signals.times_s
    touch_s = (float(frame_times[touch.first]), float(frame_times[touch.last]))
    inside = slice(touch.first, touch.last + 1)
    joint = params.joint if touch.gripped else replace(params.joint, noise=params.joint.noise.loosened())
    shape = measure_shape(demo.points_static, demo.points_moving)
    surface = demo.surface_moving(SURFACE_SD_M)
    moments = _begin(seen, demo, params)
    rested_s = (touch_s if touch.gripped else seen)[0]
    begin = (moments, carry_part(demo.robot, demo.log, rested_s, moments))
    contacts, found = _explained(demo, shape, surface, begin, seen, joint)
    return RecoveryInput(
        demo=demo,
        seen=seen,
        touch_s=touch_s,
        gripped=touch.gripped,
        joint=joint,
        shape=shape,
        surface=surface,
        contacts=contacts,
        found=found,
        picture=TouchObservation(
            times_s=frame_times[inside],
            seen=Departures(left=departures.left[inside], ahead=departures.ahead[inside]),
            sight=Detectability(noise=interval.threshold / 3, pixel_m=0.0),
        ),
    )


def recover_motion(first: RecoveryInput, joint_type: JointType, params: MotionParams) -> RecoveredMotion:
    """Contact, joint and values, if the joint is of a type.

    Twice: the second round uses the interval that the first one felt.

    Raises:
        DemonstrationTooShortError: The hand moved the part less than 3 cm.
    """
    demo, shape, seen = first.demo, first.shape, first.seen
    times = _dense(first.touch_s)
    poses = ee_poses_at(demo, times)
    leave = find_motion_tolerance(joint_type)

    def along(found: JointCandidates, interval: tuple[float, float]) -> ValueTrajectory:
        estimate = found.of(joint_type)
        reference = int(np.argmin(np.abs(times - interval[0])))
        path = compute_path_values(estimate.joint, poses, estimate.grasp_ee, reference, shape.face_normal)
        values = smooth_within(path, _DENSE_STEP_S, _SMOOTH_S, leave)
        if not first.gripped:
            points = apply(poses, estimate.grasp_ee[None])
            hand = (points, apply(invert(estimate.joint.motion(values)), points))
            return follow_pushed_part(times, values, hand, interval, leave, first.picture)
        felt, levels = refine_interval(times, values, seen, leave)
        start, end = (_nearby(felt[k], seen[k], _AGREE_S) for k in (0, 1))
        return ValueTrajectory(times_s=times, values=values, interval=(start, end), levels=levels)

    def beginning(found: JointCandidates, trajectory: ValueTrajectory) -> tuple[Array, Array]:
        moments = _begin(trajectory.interval, demo, params)
        thetas = np.interp(moments, times, trajectory.values) - trajectory.levels[0]
        return moments, found.of(joint_type).joint.motion(thetas)

    trajectory = along(first.found, seen)
    begin = beginning(first.found, trajectory)
    _, found = _explained(demo, shape, first.surface, begin, trajectory.interval, first.joint)
    trajectory = along(found, trajectory.interval)
    contacts = _contacts(demo, shape, first.surface, beginning(found, trajectory))
    # A part that creeps off does not tell where it rested.
    rest = select_resting(times, trajectory.values, seen[0])
    return RecoveredMotion(
        contacts=contacts,
        found=found,
        estimate=found.of(joint_type),
        trajectory=trajectory,
        level_sd=(float(np.std(rest)) if len(rest) else 0.0) if first.gripped else leave,
        face_normal=shape.face_normal,
    )


def _explained(
    demo: MotionInput,
    shape: PartShape,
    surface: Array,
    begin: tuple[Array, Array],
    interval: tuple[float, float],
    params: JointParams,
) -> tuple[Contacts, JointCandidates]:
    """Contact by the part's first moments, and either type's joint by the hand's way over an interval."""
    contacts = _contacts(demo, shape, surface, begin)
    held = ee_poses_at(demo, _dense(interval))
    # Fingers that do not stand against each other push, and hold in no direction.
    normals = [patch.normal for patch in contacts.patches]
    pinched = len(normals) == 2 and float(normals[0] @ normals[1]) < 0
    hold = GraspGuess(point_ee=contacts.grasp_ee, closing_ee=demo.robot.closing_ee if pinched else None)
    return contacts, fit_candidates(held, hold, shape, params)


def _contacts(demo: MotionInput, shape: PartShape, surface: Array, begin: tuple[Array, Array]) -> Contacts:
    axes = shape.box.T_world_box[:3, :3].T
    return find_contacts(demo.robot, demo.log, (surface, axes), *begin)


def _begin(interval: tuple[float, float], demo: MotionInput, params: MotionParams) -> Array:
    """First moments of the motion from its first frame on (K,), [s]."""
    steps = np.linspace(0.0, WINDOW_S, params.contact_steps, dtype=np.float64)
    return steps + find_first_frame(demo.video.times_s, interval[0])


def find_first_frame(frames: Array, moment_s: float) -> float:
    """Time of the first of the frames (F,) at a moment or after it; the last one's where none is."""
    later = frames[frames >= moment_s - 1e-6]
    return float(later[0]) if len(later) else float(frames[-1])


def _nearby(felt_s: float, seen_s: float, limit_s: float) -> float:
    """The moment felt by the hand, unless the picture contradicts it."""
    return felt_s if abs(felt_s - seen_s) <= limit_s else seen_s


def _dense(interval: tuple[float, float]) -> Array:
    count = max(2, round((interval[1] - interval[0]) / _DENSE_STEP_S) + 1)
    return np.linspace(interval[0], interval[1], count, dtype=np.float64)


def ee_poses_at(demo: MotionInput, times_s: Array) -> Array:
    """End-effector poses (T, 4, 4), world frame, at times (T,)."""
    return np.asarray(demo.robot.ee_poses(demo.log.at(times_s)[0]), np.float64)
