"""Contact, joint and joint values from the hand's path during the touch."""

from dataclasses import dataclass

import numpy as np

from aomgen.core.joint import Joint, JointType
from aomgen.core.values import Array
from aomgen.motion.contact import Contacts, PartPath, find_contacts
from aomgen.motion.demonstration import Demonstration
from aomgen.motion.geometry import shape_of
from aomgen.motion.joint import Candidates, JointEstimate, candidates
from aomgen.motion.keyframe_view import KeyframeView
from aomgen.motion.params import MotionParams
from aomgen.motion.theta import LEAVE_M, LEAVE_RAD, leaving_and_arriving, path_values, smooth_within

_DENSE_STEP_S = 0.01
_SMOOTH_S = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovery:
    """Joint and values along the touch, with the refined interval."""

    contacts: Contacts
    found: Candidates
    estimate: JointEstimate
    joint: Joint
    interval: tuple[float, float]
    levels: tuple[float, float]
    times_s: Array
    values: Array
    face_normal: Array


def recover(
    demo: Demonstration,
    view: KeyframeView,
    seen: tuple[float, float],
    joint_type: JointType,
    params: MotionParams,
) -> Recovery:
    """Contact, joint and values, if the joint is of a type.

    Twice: the second round uses the interval that the first one felt.

    Raises:
        DemonstrationTooShortError: The hand moved the part less than 3 cm.
    """
    touch, frame_times, offset_s = view.touch, view.signals.times_s, demo.clock_offset_s
    touch_s = (float(frame_times[touch.first]), float(frame_times[touch.last]))
    if not touch.gripped:
        touch_s = (touch_s[0], min(touch_s[1], seen[1] + 0.5))
    interval = seen
    shape = shape_of(demo.points_static, demo.points_moving)
    surface = demo.surface_moving(params.contact.spacing_m)
    axes = shape.box.T_world_box[:3, :3].T
    begin = PartPath.carried(
        demo.robot,
        demo.log,
        (touch_s if touch.gripped else interval)[0] + offset_s,
        _begin(interval, demo, params),
    )
    for _ in range(2):
        contacts = find_contacts(demo.robot, demo.log, surface, axes, begin)
        held = _dense(interval)
        found = candidates(poses_at(demo, held + offset_s), contacts.grasp_ee, shape, params.joint)
        estimate = found.of(joint_type)
        times = _dense(touch_s)
        reference = int(np.argmin(np.abs(times - interval[0])))
        poses = poses_at(demo, times + offset_s)
        path = path_values(estimate.joint, poses, estimate.grasp_ee, reference, shape.face_normal)
        leave = LEAVE_RAD if estimate.joint.type == "revolute" else LEAVE_M
        values = smooth_within(path.values, _DENSE_STEP_S, _SMOOTH_S, leave)
        felt, levels = leaving_and_arriving(times, values, seen, leave, gripped=touch.gripped)
        interval = (_nearby(felt[0], seen[0], params.agree_s), _nearby(felt[1], seen[1], params.agree_s))
        moments = _begin(interval, demo, params)
        thetas = np.interp(moments - offset_s, times, values) - levels[0]
        begin = PartPath(times_log_s=moments, Ts_world_part=estimate.joint.motion(thetas))
    return Recovery(
        contacts=contacts,
        found=found,
        estimate=estimate,
        joint=estimate.joint,
        interval=interval,
        levels=levels,
        times_s=times,
        values=values,
        face_normal=shape.face_normal,
    )


def _begin(interval: tuple[float, float], demo: Demonstration, params: MotionParams) -> Array:
    """First moments of the motion from its first frame on, log clock (K,), [s]."""
    contact = params.contact
    steps = np.linspace(0.0, contact.window_s, contact.steps, dtype=np.float64)
    return steps + (first_frame(demo.video.times_s, interval[0]) + demo.clock_offset_s)


def first_frame(frames: Array, moment_s: float) -> float:
    """Time of the first of the frames (F,) at a moment or after it; the last one's where none is."""
    later = frames[frames >= moment_s - 1e-6]
    return float(later[0]) if len(later) else float(frames[-1])


def _nearby(felt_s: float, seen_s: float, limit_s: float) -> float:
    """The moment felt by the hand, unless the picture contradicts it."""
    return felt_s if abs(felt_s - seen_s) <= limit_s else seen_s


def _dense(interval: tuple[float, float]) -> Array:
    count = max(2, round((interval[1] - interval[0]) / _DENSE_STEP_S) + 1)
    return np.linspace(interval[0], interval[1], count, dtype=np.float64)


def poses_at(demo: Demonstration, log_times_s: Array) -> Array:
    """End-effector poses (T, 4, 4), world frame, at times (T,) of the log's clock."""
    return np.asarray(demo.robot.ee_poses(demo.log.at(log_times_s)[0]), np.float64)
