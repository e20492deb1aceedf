"""Contact, joint and joint values from the gripper's path during the touch."""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.conventions import MOVING
from aomgen.core.joint import JointType
from aomgen.core.motion import MotionEstimate
from aomgen.core.parts import spread_points
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.motion.contact import SURFACE_SD_M, Contacts, carry_part, find_contacts
from aomgen.motion.ee_path import GraspGuess, measure_slip
from aomgen.motion.inputs import MotionInput
from aomgen.motion.joint_estimation import JointCandidates, JointEstimate, JointParams, fit_candidates
from aomgen.motion.joint_value import (
    ValueTrajectory,
    compute_path_value_sd,
    compute_path_values,
    estimate_level_sd,
    find_motion_tolerance,
    follow_pushed_part,
    refine_interval,
    sample_at_frames,
    smooth_within,
)
from aomgen.motion.observations import DENSE_STEP_S, VideoObservations
from aomgen.motion.part_shape import PartShape, infer_direction, measure_shape

# Contact patches are followed for this time after the start of the motion, [s].
WINDOW_S = 0.3
# Width of the smoother of joint values, [s]; short compared with any commanded motion.
_SMOOTH_S = 0.2
# Largest difference between the times of an event in the video and in the gripper's path, [s].
_AGREE_S = 0.8

# Start and end of a motion, [s].
Times = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchRecovery:
    """Inputs of a recovery that are the same for both joint types.

    Attributes:
        demo: Video, log and scan.
        view: The touch, and the interval seen in the video.
        params: Parameters of the joint estimate.
        contact_steps: Number of moments at which contact is searched.
        shape: Shape of the parts.
        surface: Points of the moving part (N, 3) without gaps along thin structures, world frame, [m].
    """

    demo: MotionInput
    view: VideoObservations
    params: JointParams
    contact_steps: int
    shape: PartShape
    surface: Array

    @staticmethod
    def of(
        demo: MotionInput, view: VideoObservations, params: JointParams, contact_steps: int
    ) -> "TouchRecovery":
        """Prepare a recovery, with the shape of the parts measured."""
        pushed = replace(params, noise=params.noise.loosen())
        return TouchRecovery(
            demo=demo,
            view=view,
            params=params if view.seen.touch.gripped else pushed,
            contact_steps=contact_steps,
            shape=measure_shape(demo.points_static, demo.points_moving),
            surface=spread_points(demo.scene, demo.labels, MOVING, SURFACE_SD_M),
        )

    def first_candidates(self) -> JointCandidates:
        """Estimate the joint of either type from the interval seen in the video.

        Raises:
            DemonstrationTooShortError: The gripper moved the part less than 3 cm.
        """
        (start_s, _), seen = self.view.interval, self.view.seen
        moments = self._begin(start_s)
        rested_s = float(seen.times_s[seen.touch.first]) if seen.touch.gripped else start_s
        Ts_world_part = carry_part(self.demo, rested_s, moments)
        return self._fit(self._contacts(moments, Ts_world_part), self.view.interval)

    def recover(
        self, found: JointCandidates, joint_type: JointType, likelihood_ratio: float = 1.0
    ) -> tuple[JointCandidates, MotionEstimate]:
        """Recover contact, joint and values for a joint type.

        Two rounds are run: the second one uses the interval that the first one found in the gripper's path.

        Args:
            found: Result of `first_candidates`.
            joint_type: Type of the recovered joint.
            likelihood_ratio: Likelihood ratio of the prompted part over any other region.

        Returns:
            Candidates from the gripper's path in the refined interval, and the estimate of the type.

        Raises:
            DemonstrationTooShortError: The gripper moved the part less than 3 cm.
        """
        estimate = found.of(joint_type)
        trajectory = self._follow(estimate, self.view.interval)
        found = self._fit(self._first_contacts(estimate, trajectory), trajectory.interval)
        estimate = found.of(joint_type)
        return found, self._assemble(estimate, self._follow(estimate, trajectory.interval), likelihood_ratio)

    def _assemble(
        self, estimate: JointEstimate, trajectory: ValueTrajectory, likelihood_ratio: float
    ) -> MotionEstimate:
        """Assemble the estimate that the rest of the pipeline reads."""
        demo, frames = self.demo, self.demo.video.times_s
        start_s, end_s = trajectory.interval
        thetas = sample_at_frames(frames, trajectory, find_motion_tolerance(estimate.joint.type))
        moving = (frames >= start_s) & (frames <= end_s)
        before_end = frames[frames <= end_s + 1e-6]
        joint = replace(estimate.joint, lower=0.0, upper=float(thetas.max()))
        poses = demo.ee_poses_at(frames)
        slips, pivots = measure_slip(joint, thetas, poses, estimate.grasp_ee, int(np.argmax(moving)))
        return MotionEstimate(
            clock_offset_s=demo.clock.offset_s,
            clock_offset_sd_s=demo.clock.sd_s,
            start_s=find_first_frame(frames, start_s),
            end_s=float(before_end[-1] if len(before_end) else frames[0]),
            curve=self.view.curve,
            contacts=self._first_contacts(estimate, trajectory)[0],
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
            theta_sd=self._theta_sd(estimate, trajectory, thetas),
            slip_m=np.where(moving, np.linalg.norm(slips, axis=1), 0.0),
            pivot_rad=np.where(moving, np.linalg.norm(pivots, axis=1), 0.0),
            direction=infer_direction(joint, float(thetas[-1]), demo.points_static, demo.points_moving),
            part_odds=likelihood_ratio,
        )

    def _theta_sd(self, estimate: JointEstimate, trajectory: ValueTrajectory, thetas: Array) -> Array:
        """Compute the standard deviation (F,) of the values by joint, grasp, clock and rest level, [rad], [m]."""
        frames, times, values = self.demo.video.times_s, trajectory.times_s, trajectory.values
        level_sd = find_motion_tolerance(estimate.joint.type)
        if self.view.seen.touch.gripped:
            level_sd = estimate_level_sd(times, values, self.view.interval[0], level_sd)
        moments = np.append(trajectory.interval[0], np.clip(frames, *trajectory.interval))
        poses, face_normal = self.demo.ee_poses_at(moments), self.shape.face_normal
        path_sd = compute_path_value_sd(estimate, poses, np.append(0.0, thetas), face_normal)[1:]
        speed = np.abs(np.interp(frames, times, np.gradient(values, times)))
        clock_sd = np.where(thetas > 0, speed, 0.0) * self.demo.clock.sd_s
        return np.sqrt(path_sd**2 + clock_sd**2 + np.where(thetas > 0, level_sd, 0.0) ** 2)

    def _follow(self, estimate: JointEstimate, interval: Times) -> ValueTrajectory:
        """Compute values along the touch for a joint that moves in about this interval."""
        seen = self.view.seen
        frames_s = seen.times_s[seen.touch.frames]
        times = _dense((float(frames_s[0]), float(frames_s[-1])))
        poses = self.demo.ee_poses_at(times)
        leave = find_motion_tolerance(estimate.joint.type)
        reference = int(np.argmin(np.abs(times - interval[0])))
        path = compute_path_values(
            estimate.joint, poses, estimate.grasp_ee, reference, self.shape.face_normal
        )
        values = smooth_within(path, DENSE_STEP_S, _SMOOTH_S, leave)
        if not seen.touch.gripped:
            points = apply(poses, estimate.grasp_ee[None])
            touching = (points, apply(invert(estimate.joint.motion(values)), points))
            return follow_pushed_part(times, values, touching, interval, leave, seen)
        felt, levels = refine_interval(times, values, self.view.interval, leave)
        # The gripper's path determines the moment, unless the video contradicts it.
        pairs = zip(felt, self.view.interval, strict=True)
        start, end = (f if abs(f - s) <= _AGREE_S else s for f, s in pairs)
        return ValueTrajectory(times_s=times, values=values, interval=(start, end), levels=levels)

    def _first_contacts(self, estimate: JointEstimate, trajectory: ValueTrajectory) -> Contacts:
        """Find the contacts at the first moments of a motion."""
        moments = self._begin(trajectory.interval[0])
        thetas = np.interp(moments, trajectory.times_s, trajectory.values) - trajectory.levels[0]
        return self._contacts(moments, estimate.joint.motion(thetas))

    def _begin(self, start_s: float) -> Array:
        steps = np.linspace(0.0, WINDOW_S, self.contact_steps, dtype=np.float64)
        return steps + find_first_frame(self.demo.video.times_s, start_s)

    def _contacts(self, moments: Array, Ts_world_part: Array) -> Contacts:
        part = (self.surface, self.shape.box.T_world_box[:3, :3].T)
        return find_contacts(self.demo, part, moments, Ts_world_part)

    def _fit(self, contacts: Contacts, interval: Times) -> JointCandidates:
        """Fit the joint of either type to the gripper's path over an interval."""
        patches, grasp_ee = contacts
        # Fingers that do not oppose each other push, and hold the part in no direction.
        normals = [patch.normal for patch in patches]
        pinched = len(normals) == 2 and float(normals[0] @ normals[1]) < 0
        closing_ee = self.demo.robot.closing_ee if pinched else None
        hold = GraspGuess(point_ee=grasp_ee, closing_ee=closing_ee)
        return fit_candidates(self.demo.ee_poses_at(_dense(interval)), hold, self.shape, self.params)


def find_first_frame(frames: Array, moment_s: float) -> float:
    """Find the time of the first frame (F,) at or after a moment; the last frame's if there is none."""
    later = frames[frames >= moment_s - 1e-6]
    return float(later[0]) if len(later) else float(frames[-1])


def _dense(interval: Times) -> Array:
    count = max(2, round((interval[1] - interval[0]) / DENSE_STEP_S) + 1)
    return np.linspace(interval[0], interval[1], count, dtype=np.float64)
