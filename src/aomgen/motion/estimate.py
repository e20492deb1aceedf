"""AOMotion: from one demonstration to when, where and how the part moved."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from aomgen.core.motion import MotionCurve, MotionEstimate
from aomgen.core.progress import Progress, silent
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.errors import InputError
from aomgen.motion.ee_path import measure_slip
from aomgen.motion.inputs import MotionInput
from aomgen.motion.joint_estimation import JointCandidates, choose_type
from aomgen.motion.joint_trajectory import (
    RecoveredMotion,
    find_first_frame,
    prepare_recovery,
    recover_motion,
)
from aomgen.motion.joint_value import compute_path_values, find_motion_tolerance, sample_at_frames
from aomgen.motion.kinematic_prior import make_kinematic_prior
from aomgen.motion.observations import VideoObservations
from aomgen.motion.opening_direction import infer_direction
from aomgen.motion.params import MotionParams
from aomgen.motion.photometric import (
    PhotometricFrames,
    compute_type_margin,
    refine_estimate,
    select_frames,
)
from aomgen.motion.photometric_residuals import JointMotion
from aomgen.robots.silhouette import MasksAt, robot_masks

# One of so many samples of the joint is carried to the values.
_EVERY = 8


def _ignore_curve(curve: MotionCurve) -> None:
    """Nobody wants the curve before the answer."""


def estimate_motion(
    demonstration: MotionInput,
    params: MotionParams | None = None,
    progress: Progress = silent,
    on_curve: Callable[[MotionCurve], None] = _ignore_curve,
) -> MotionEstimate:
    """Recover the part's motion.

    Args:
        demonstration: Video, log and scan.
        params: Of the submodules.
        progress: Hears how far it is.
        on_curve: Hears the motion score as soon as it is known, before anything that it shows is refused.

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
        view = VideoObservations.of(demo, masks_at, params)
        seen, interval = view.interval()
        curve = view.curve(seen, interval)
        on_curve(curve)
        signs = view.signs(demo, interval)
        moved = view.identify_part(demo)
        if moved.gripped or signs.log_likelihood_ratio > 0:
            moved.check()
        signs.check()
        progress(0.4, "joint")
        first = prepare_recovery(demo, view, seen, interval, params)
        doors, drawers = (
            _estimate_type(
                demo, masks_at, curve, moved.odds, recover_motion(first, joint_type, params), params
            )
            for joint_type in ("revolute", "prismatic")
        )
    progress(0.9, "type of the joint")
    video_margin = compute_type_margin(
        doors.seen, (doors.joint_motion, drawers.joint_motion), params.photometric
    )
    found = min((doors.found, drawers.found), key=lambda item: abs(item.margin))
    answer = doors if choose_type(found, video_margin) == "revolute" else drawers
    return replace(answer.refined, type_margin=abs(found.margin + video_margin))


def first_motion(demo: MotionInput, params: MotionParams | None = None) -> MotionEstimate:
    """The motion by the hand's path alone, not refined on the video, and nothing of it judged.

    It tells which Gaussians move, also where labels are too poor for `estimate_motion`.

    Raises: as `estimate_motion`.
    """
    params = params or MotionParams()
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        view = VideoObservations.of(demo, masks_at, params)
        seen, interval = view.interval()
        first = prepare_recovery(demo, view, seen, interval, params)
    joint_type = "revolute" if first.found.margin > 0 else "prismatic"
    return assemble(demo, view.curve(seen, interval), recover_motion(first, joint_type, params), odds=1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class _TypeEstimate:
    """The answer if the joint is of a type: by the hand's path, the video as read for it, and refined on it."""

    found: JointCandidates
    seen: PhotometricFrames | None
    refined: MotionEstimate

    @property
    def joint_motion(self) -> JointMotion:
        """What the video is compared with."""
        return self.refined.joint, self.refined.thetas


def _estimate_type(
    demo: MotionInput,
    masks_at: MasksAt,
    curve: MotionCurve,
    odds: float,
    recovery: RecoveredMotion,
    params: MotionParams,
) -> _TypeEstimate:
    lines = (recovery.estimate.axes, recovery.estimate.origins)
    estimate = assemble(demo, curve, recovery, odds)
    hand = make_kinematic_prior(demo, estimate, lines)
    seen = select_frames(demo, masks_at, hand, params.photometric)
    refined = refine_estimate(seen, estimate, hand, params.photometric)
    return _TypeEstimate(found=recovery.found, seen=seen, refined=refined)


def assemble(demo: MotionInput, curve: MotionCurve, recovery: RecoveredMotion, odds: float) -> MotionEstimate:
    """The estimate as the rest of the pipeline reads it."""
    frames = demo.video.times_s
    estimate, trajectory = recovery.estimate, recovery.trajectory
    thetas = sample_at_frames(frames, trajectory, find_motion_tolerance(estimate.joint.type))
    moving = (frames >= trajectory.interval[0]) & (frames <= trajectory.interval[1])
    joint = replace(estimate.joint, lower=0.0, upper=float(thetas.max()))
    poses = demo.ee_poses_at(frames)
    slips, pivots = measure_slip(joint, thetas, poses, estimate.grasp_ee, int(np.argmax(moving)))
    return MotionEstimate(
        clock_offset_s=demo.clock.offset_s,
        clock_offset_sd_s=demo.clock.sd_s,
        start_s=find_first_frame(frames, trajectory.interval[0]),
        end_s=_last_frame(frames, trajectory.interval[1]),
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
        slip_m=np.where(moving, np.linalg.norm(slips, axis=1), 0.0),
        pivot_rad=np.where(moving, np.linalg.norm(pivots, axis=1), 0.0),
        direction=infer_direction(joint, float(thetas[-1]), demo.points_static, demo.points_moving),
        part_odds=odds,
    )


def _theta_sd(demo: MotionInput, recovery: RecoveredMotion, thetas: Array, frames: Array) -> Array:
    """Standard deviation (F,) of the values, [rad] or [m]: of the joint, the grasp, the clock and the level at rest."""
    estimate, trajectory = recovery.estimate, recovery.trajectory
    joint = estimate.joint
    first, last = trajectory.interval
    moments = np.clip(frames, first, last)
    poses = demo.ee_poses_at(np.concatenate([[first], moments]))
    draws = zip(*(rows[::_EVERY] for rows in (estimate.axes, estimate.origins, estimate.grasps)), strict=True)
    values = [
        compute_path_values(replace(joint, axis=axis, origin=origin), poses, grasp, 0, recovery.face_normal)
        for axis, origin, grasp in draws
    ]
    offset = apply(poses[0], estimate.grasp_ee) - joint.origin
    radius = float(np.linalg.norm(np.cross(offset, joint.axis))) if joint.type == "revolute" else 1.0
    grasp_sd = np.hypot(estimate.residual_m / radius, estimate.give_rate * thetas)
    speed = np.abs(np.interp(frames, trajectory.times_s, np.gradient(trajectory.values, trajectory.times_s)))
    clock_sd = np.where(thetas > 0, speed, 0.0) * demo.clock.sd_s
    level_sd = np.where(thetas > 0, recovery.level_sd, 0.0)
    return np.sqrt(np.std(values, axis=0)[1:] ** 2 + grasp_sd**2 + clock_sd**2 + level_sd**2)


def _last_frame(frames: Array, moment_s: float) -> float:
    earlier = frames[frames <= moment_s + 1e-6]
    return float(earlier[-1]) if len(earlier) else float(frames[0])
