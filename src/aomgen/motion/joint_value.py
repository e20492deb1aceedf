"""The joint value over time, in closed form from the gripper's path.

A gripper that holds the part shows its value from rest to rest. One that pushes or hooks only moves the part
forward: before contact and after release the gripper moves freely, and in between the part is as far as the
gripper has ever pushed it. The video shows where on the gripper's path contact begins and ends.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Final

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from aomgen.core.joint import Joint, JointType
from aomgen.core.robust import robust_sd
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.motion.ee_path import GripperPath, smooth
from aomgen.motion.joint_estimation import JointEstimate
from aomgen.motion.keyframes import STILL_M, ChangeFractions, detect_offset, detect_onset

# Beyond this share of the radius the face is too close to the axis to correct for sliding.
_MAX_FACE_SHARE = 0.7
# Smoothing changes a value by at most this many standard deviations of its noise.
_NOISE_SDS = 3.0
# While a part is held, its rest is observed from the first to the second of these times before it moves, [s].
_REST_S = (0.5, 0.1)
# Shortest rest of a held part from which the value at rest is measured, [s].
_LEAST_REST_S = 0.1
# A gripper has left the part when it moves sideways, farther than along the part's path, by
# this much in this time.
_ASIDE_M, _ASIDE_S = 0.004, 0.1
# A part has left its first state when its value differs by this much, [rad], [m]: half a degree, and half a
# degree of a door whose handle is 0.23 m from its hinge.
LEAVE_RAD, LEAVE_M = float(np.radians(0.5)), 0.002
# Fingers and handle deform by 1 to 3 mm before the part follows the gripper. For hinges, half of this is already included in the
# slip rate (`_GIVE_RATES` of `joint_posterior`), [m].
YIELD_M: Final[dict[JointType, float]] = {"prismatic": 0.002, "revolute": 0.001}


@dataclass(frozen=True, slots=True, kw_only=True)
class ValueTrajectory:
    """Joint values along a touch, and when and where the part rests.

    Attributes:
        times_s: Dense times, [s].
        values: Smooth values, growing in the demonstrated direction, [rad] or [m].
        interval: Start and end of the motion, [s].
        levels: Values of the part at rest before and after.
    """

    times_s: Annotated[Array, "T"]
    values: Annotated[Array, "T"]
    interval: tuple[float, float]
    levels: tuple[float, float]

    __post_init__ = freeze_arrays


def find_motion_tolerance(joint_type: JointType) -> float:
    """Return the value by which a part has left its first state or not reached its last one, [rad] or [m]."""
    return LEAVE_RAD if joint_type == "revolute" else LEAVE_M


def compute_path_values(
    joint: Joint, Ts_world_ee: Array, grasp_ee: Array, reference: int, face_normal: Array | None = None
) -> Array:
    """Compute joint values (T,), [rad] or [m], from gripper poses that hold the part.

    Prismatic: `a . (p_t - p_ref)`. Revolute: `atan2(y_t, x_t) - asin(h / rho_t)` with x along the
    part's face, y across it and h the held point's height over the face's plane through the axis;
    the value does not change when the gripper slides along the face.

    Args:
        joint, face_normal: Axis, origin and the outward normal of the part's face (3,) at value 0, world
            frame; without a normal the point is fixed to the part.
        Ts_world_ee, grasp_ee: Poses (T, 4, 4) in the order of time, and the held point (3,),
            end-effector frame, [m].
        reference: Index of the pose that has value 0.

    Source: AOMGen, sec. 4.2, "Movable Part Motion Recovery"; its plane-trajectory intersection in
    closed form.
    """
    points = apply(Ts_world_ee, grasp_ee)
    if joint.type == "prismatic":
        return (points - points[reference]) @ joint.axis
    offsets = points - joint.origin
    flat = offsets - np.outer(offsets @ joint.axis, joint.axis)
    radii = np.maximum(np.linalg.norm(flat, axis=1), 1e-6)
    height = 0.0
    if face_normal is not None:
        across = face_normal - (face_normal @ joint.axis) * joint.axis
        length = float(np.linalg.norm(across))
        height = float(flat[reference] @ across) / length if length > 0.5 else 0.0
    if not abs(height) < _MAX_FACE_SHARE * radii.min():
        height = 0.0
    first = flat[reference]
    turn = np.unwrap(np.arctan2(np.cross(first, flat) @ joint.axis, flat @ first))
    # The side of the face, seen along the axis, determines the sign of the correction.
    side = 1.0 if face_normal is None else float(np.sign(np.cross(joint.axis, first) @ face_normal)) or 1.0
    lean = side * np.arcsin(height / radii)
    values = turn - (lean - lean[reference])
    return np.asarray(values - values[reference], np.float64)


def compute_path_value_sd(
    estimate: JointEstimate,
    Ts_world_ee: Array,
    values: Array,
    face_normal: Array | None = None,
    *,
    yield_m: float = 0.0,
) -> Array:
    """Compute the standard deviation (T,) of joint values that follow from a path, [rad] or [m].

    It combines the errors of axis, origin and held point, the unsteadiness and the yield of the grasp, and
    the slip, which grows with the travel.

    Args:
        estimate: Joint with equally likely axes, origins and held points.
        Ts_world_ee, face_normal: See `compute_path_values`; the first pose has value 0.
        values: Joint values (T,) at the poses.
        yield_m: Standard deviation of the distance by which the grasp yields before the part follows, see `YIELD_M`, [m].
    """
    joint = estimate.joint
    draws = zip(estimate.axes, estimate.origins, estimate.grasps, strict=True)
    likely = [
        compute_path_values(replace(joint, axis=axis, origin=origin), Ts_world_ee, grasp, 0, face_normal)
        for axis, origin, grasp in draws
    ]
    arm = apply(Ts_world_ee[0], estimate.grasp_ee) - joint.origin
    radius = float(np.linalg.norm(np.cross(arm, joint.axis))) if joint.type == "revolute" else 1.0
    slip_sd = np.hypot(np.hypot(estimate.residual_m, yield_m) / radius, estimate.give_rate * values)
    return np.hypot(np.std(likely, axis=0), slip_sd)


def smooth_within(values: Array, step_s: float, window_s: float, tolerance: float) -> Array:
    """Smooth joint values (T,) without leaving the range of the values around them.

    A polynomial smoother rings where the part starts, pauses and stops; here a pause stays level and
    no end is overshot. Where the values are monotonic up to `tolerance`, so is the result.

    Args:
        values: Dense joint values (T,), [rad] or [m].
        step_s, window_s: Time between samples, and width of the smoother, [s].
        tolerance: Backward motion that counts as noise, see `find_motion_tolerance`.
    """
    window = max(3, 2 * round(window_s / step_s / 2) + 1)
    low, high = minimum_filter1d(values, window), maximum_filter1d(values, window)
    smoothed = np.clip(smooth(values, step_s, window_s), low, high)
    # A fast motion bends within the window: a difference beyond the noise is kept.
    noise = _NOISE_SDS * robust_sd(values - smoothed)
    smoothed = np.clip(smoothed, values - noise, values + noise)
    way = 1.0 if values[-1] >= values[0] else -1.0
    rising, ceiling = way * smoothed, np.maximum.accumulate(way * smoothed)
    if not float((ceiling - rising).max()) <= tolerance:
        return np.asarray(smoothed, np.float64)
    floor = np.minimum.accumulate(rising[::-1])[::-1]
    return np.asarray(way * (ceiling + floor) / 2, np.float64)


def refine_interval(
    times_s: Array, values: Array, seen: tuple[float, float], tolerance: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Find when the value first differs from its first level, and when it last differs from its last level.

    Args:
        times_s, values: Dense times [s] from touch to release of a holding gripper, and
            smooth joint values (T,).
        seen: Start and end as seen in the video, [s].
        tolerance: Difference that counts as motion, see `find_motion_tolerance`.

    Returns:
        These times, and the two levels.
    """
    start_s, end_s = seen
    first_level, last_level = np.interp(seen, times_s, values)
    # A video that begins with a closed grasp shows no rest: the level is then its first value.
    first_level = values[0] if times_s[0] <= start_s else first_level
    first_level = _level(select_resting(times_s, values, start_s), first_level)
    last_level = _level(values[(times_s >= times_s[-1] - 0.2) & (times_s >= end_s)], last_level)
    left = np.abs(values - first_level) > tolerance
    ahead = np.abs(values - last_level) > tolerance
    # From the middle of the motion outwards, so that the approach and the retreat do not count.
    middle = int(np.argmin(np.abs(times_s - (start_s + end_s) / 2)))
    still = np.flatnonzero(~left[: middle + 1])
    arrived = np.flatnonzero(~ahead[middle:])
    begin = float(times_s[min(still[-1] + 1, middle)]) if len(still) else float(times_s[0])
    finish = float(times_s[max(middle + arrived[0] - 1, middle)]) if len(arrived) else float(times_s[-1])
    return (begin, finish), (float(first_level), float(last_level))


def select_resting(times_s: Array, values: Array, start_s: float) -> Array:
    """Select the values (T,) at which a held part rests before a motion that starts at `start_s`."""
    since, until = _REST_S
    return values[(times_s >= start_s - since) & (times_s <= start_s - until)]


def estimate_level_sd(times_s: Array, values: Array, start_s: float, tolerance: float) -> float:
    """Estimate the standard deviation of the value (T,) at which a held part rests before a motion.

    It is that of the values at rest, or `tolerance` where the part is held too briefly.
    """
    rest = select_resting(times_s, values, start_s)
    enough = len(rest) > 1 and (len(rest) - 1) * (times_s[1] - times_s[0]) >= _LEAST_REST_S
    return float(np.std(rest)) if enough else tolerance


def _level(values: Array, otherwise: float) -> float:
    return float(np.median(values)) if len(values) else otherwise


def follow_pushed_part(
    times_s: Array,
    values: Array,
    touching: tuple[Array, Array],
    seen_s: tuple[float, float],
    leave: float,
    seen: ChangeFractions,
) -> ValueTrajectory:
    """Compute the values of a pushed part from those that a holding gripper would give.

    Args:
        times_s, values: Dense times of the touch [s], and the joint value if the gripper held the part all
            the time (T,), smooth, growing in the demonstrated direction.
        touching: The touching point (T, 3) in the world, and relative to the part if the gripper held it, [m].
        seen_s: First estimate of start and end, [s]. The gripper certainly pushes at the frame that differs most from both the
            first and the last state of the part, or at the middle of this interval if the video shows no change.
        leave: Change of the value at which a motion has begun, see `find_motion_tolerance`.
        seen: Changes in the video during the touch.
    """
    scores, noise = seen.scores, max(seen.noises)
    pushing_s = seen.times_s[np.argmax(scores)] if scores.max() > seen.threshold else sum(seen_s) / 2
    middle = int(np.argmin(np.abs(times_s - pushing_s)))
    gone = middle + _left(times_s[middle:], *(points[middle:] for points in touching))
    farthest = _farthest(values[np.minimum(np.arange(len(values)), gone - 1)], middle)
    along = np.zeros((len(values), 3))
    along[:, 0] = farthest * (STILL_M / leave)
    way = GripperPath(times_s=times_s, points=along)
    frames_s, left, ahead = (row[seen.touch.frames] for row in (seen.times_s, seen.left, seen.ahead))
    start_s = detect_onset(way, frames_s, left, noise, 0.0, held=False)
    end_s = detect_offset(way, frames_s, ahead, noise, 0.0, held=False)
    interval = (min(start_s, end_s), max(start_s, end_s))
    first, last = np.interp(interval, times_s, farthest)
    return ValueTrajectory(
        times_s=times_s, values=farthest, interval=interval, levels=(first - leave, last + leave)
    )


def _left(times_s: Array, points_world: Array, points_part: Array) -> int:
    """Find the index (at least 1) from which the gripper has left the part sideways; T if it never does."""
    later = np.searchsorted(times_s, times_s + _ASIDE_S).clip(max=len(times_s) - 1)
    aside = np.linalg.norm(points_part[later] - points_part, axis=1)
    moved = np.linalg.norm(points_world[later] - points_world, axis=1)
    # The sideways component must be more than half of the squared displacement.
    off = (aside > _ASIDE_M) & (2 * aside**2 > moved**2)
    return max(1, int(np.argmax(off))) if off.any() else len(times_s)


def _farthest(values: Array, middle: int) -> Array:
    """Remove backward motion of the gripper, before and after contact, from values (T,)."""
    return np.concatenate(
        [np.minimum.accumulate(values[: middle + 1][::-1])[::-1], np.maximum.accumulate(values[middle:])[1:]]
    )


def sample_at_frames(frame_times_s: Array, trajectory: ValueTrajectory, tolerance: float) -> Array:
    """Sample values (F,) at frame times, never below 0; the part rests before and after the motion.

    The interval begins when the value has left its first level by a tolerance. Between the last moment at
    that level and the interval, the value follows the gripper; the same holds at the last level.

    `tolerance`: see `find_motion_tolerance`.
    """
    times, values = trajectory.times_s, trajectory.values
    start_s, end_s = trajectory.interval
    first, last = trajectory.levels
    inside = np.interp(frame_times_s, times, values) - first
    whole = last - first
    left = times[(times <= start_s) & (values <= first)]
    reached = times[(times >= end_s) & (values >= last)]
    leaving = (frame_times_s >= (left[-1] if len(left) else start_s)) & (inside <= tolerance)
    arriving = (frame_times_s <= (reached[0] if len(reached) else end_s)) & (inside >= whole - tolerance)
    thetas = np.where((frame_times_s < start_s) & ~leaving, 0.0, inside)
    thetas = np.where((frame_times_s > end_s) & ~arriving, whole, thetas)
    return np.maximum(thetas, 0.0)
