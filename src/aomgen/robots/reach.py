"""How far an arm gets."""

from dataclasses import dataclass

import numpy as np

from aomgen.core.values import Vector3, freeze_arrays
from aomgen.robots.robot import RobotModel


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach:
    """How far an arm gets: about which point, and the farthest end effector, [m]."""

    shoulder_world: Vector3
    reach_m: float

    __post_init__ = freeze_arrays


def longest_reach(robot: RobotModel, samples: int = 2000) -> Reach:
    """Point about which the arm reaches farthest, and how far its end effector gets.

    The point is the highest one on the first joint's line that keeps the farthest sampled
    pose nearest, which for most arms is the shoulder.
    """
    rng = np.random.default_rng(0)
    low, high = np.clip(robot.joint_limits, -np.pi, np.pi).T
    joints = rng.uniform(low, high, (samples, len(low)))
    points = robot.ee_poses(joints)[:, :3, 3]
    foot = float(robot.link_poses(joints[:1], 0.0)[0, 0, 2, 3])
    heights = foot + np.linspace(0.0, 0.5, 26)
    middle = np.median(points[:, :2], axis=0)
    farthest = [
        float(np.linalg.norm(points - np.array([middle[0], middle[1], z]), axis=1).max()) for z in heights
    ]
    best = int(np.argmin(farthest))
    return Reach(shoulder_world=np.array([middle[0], middle[1], heights[best]]), reach_m=farthest[best])
