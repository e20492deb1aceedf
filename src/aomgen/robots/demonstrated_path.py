"""Join joint log, robot and recovered motion into one demonstration."""

import numpy as np

from aomgen.core.demonstration import Demonstration
from aomgen.core.joint_log import JointLog
from aomgen.core.motion import MotionEstimate
from aomgen.robots.robot import RobotModel


def demonstration_from(motion: MotionEstimate, log: JointLog, robot: RobotModel, fps: float) -> Demonstration:
    """Sample the recorded demonstration at a constant rate.

    Args:
        motion: Recovered motion; brings the video's times and the clock offset.
        log: Joint log on its own clock; its noise is averaged over a sample's length.
        robot: For the end effector's poses.
        fps: Samples a second.

    Returns:
        Samples from the first to the last video frame.
    """
    first, last = float(motion.times_s[0]), float(motion.times_s[-1])
    times = first + np.arange(int((last - first) * fps + 1e-6) + 1) / fps
    # Five readings about each sample, within half a sample, take most of the log's noise away.
    offsets = np.linspace(-0.25, 0.25, 5) / fps
    readings = [log.at(times + offset + motion.clock_offset_s) for offset in offsets]
    joints = np.mean([joints for joints, _ in readings], 0)
    gripper = np.clip(np.mean([gripper for _, gripper in readings], 0), 0.0, 1.0)
    return Demonstration(
        times_s=times,
        joints=joints,
        gripper=gripper,
        Ts_world_ee=robot.ee_poses(joints),
        thetas=motion.theta_at(times),
        start_s=motion.start_s,
        end_s=motion.end_s,
        joint=motion.joint,
        grasp_ee=motion.grasp_ee,
        ee_turn_ratio=motion.ee_turn_ratio,
    )
