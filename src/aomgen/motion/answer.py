"""The answer of AOMotion from its pieces: values at the video's frames and how well they are known."""

from dataclasses import replace

import numpy as np

from aomgen.core.motion import MotionCurve, MotionEstimate
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.motion.grasp_slip import measure_slip
from aomgen.motion.inputs import MotionInput
from aomgen.motion.joint_trajectory import RecoveredMotion, ee_poses_at, find_first_frame
from aomgen.motion.joint_value import compute_path_values, find_motion_tolerance, sample_at_frames
from aomgen.motion.opening_direction import infer_direction

# One of so many samples of the joint is carried to the values.
_EVERY = 8


def assemble(demo: MotionInput, curve: MotionCurve, recovery: RecoveredMotion, odds: float) -> MotionEstimate:
    """The estimate as the rest of the pipeline reads it."""
    frames = demo.video.times_s
    estimate, course = recovery.estimate, recovery.course
    thetas = sample_at_frames(frames, course, find_motion_tolerance(estimate.joint.type))
    moving = (frames >= course.interval[0]) & (frames <= course.interval[1])
    joint = replace(estimate.joint, lower=0.0, upper=float(thetas.max()))
    poses = ee_poses_at(demo, frames + demo.clock_offset_s)
    drift = measure_slip(joint, thetas, poses, estimate.grasp_ee, int(np.argmax(moving)))
    return MotionEstimate(
        clock_offset_s=demo.clock_offset_s,
        clock_offset_sd_s=demo.clock_sd_s,
        start_s=find_first_frame(frames, course.interval[0]),
        end_s=_last_frame(frames, course.interval[1]),
        curve=curve,
        contacts=recovery.contacts.patches,
        grasp_ee=estimate.grasp_ee,
        joint=joint,
        axis_sd_rad=estimate.axis_sd_rad,
        origin_sd_m=estimate.origin_sd_m,
        axis_ci95_rad=estimate.axis_ci95_rad,
        origin_ci95_m=estimate.origin_ci95_m,
        type_margin=estimate.margin,
        ee_turn_ratio=estimate.turn_ratio,
        times_s=frames,
        thetas=thetas,
        theta_sd=_theta_sd(demo, recovery, thetas, frames),
        slip_m=np.where(moving, drift.slip_m, 0.0),
        pivot_rad=np.where(moving, drift.pivot_rad, 0.0),
        direction=infer_direction(joint, float(thetas[-1]), demo.points_static, demo.points_moving),
        part_odds=odds,
    )


def _theta_sd(demo: MotionInput, recovery: RecoveredMotion, thetas: Array, frames: Array) -> Array:
    """Standard deviation (F,) of the values, [rad] or [m]: of the joint, the grasp, the clock and the level at rest."""
    estimate, course = recovery.estimate, recovery.course
    joint = estimate.joint
    first, last = course.interval
    moments = np.clip(frames, first, last)
    poses = ee_poses_at(demo, np.concatenate([[first], moments]) + demo.clock_offset_s)
    draws = zip(*(rows[::_EVERY] for rows in (estimate.axes, estimate.origins, estimate.grasps)), strict=True)
    values = [
        compute_path_values(
            replace(joint, axis=axis, origin=origin), poses, grasp, 0, recovery.face_normal
        ).values
        for axis, origin, grasp in draws
    ]
    offset = apply(poses[0], estimate.grasp_ee) - joint.origin
    radius = float(np.linalg.norm(np.cross(offset, joint.axis))) if joint.type == "revolute" else 1.0
    grasp_sd = np.hypot(estimate.residual_m / radius, estimate.give_rate * thetas)
    speed = np.abs(np.interp(frames, course.times_s, np.gradient(course.values, course.times_s)))
    clock_sd = np.where(thetas > 0, speed, 0.0) * demo.clock_sd_s
    level_sd = np.where(thetas > 0, recovery.level_sd, 0.0)
    return np.sqrt(np.std(values, axis=0)[1:] ** 2 + grasp_sd**2 + clock_sd**2 + level_sd**2)


def _last_frame(frames: Array, moment_s: float) -> float:
    earlier = frames[frames <= moment_s + 1e-6]
    return float(earlier[-1]) if len(earlier) else float(frames[0])
