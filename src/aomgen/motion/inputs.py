"""What AOMotion looks at: a video of the demonstration, the robot's log of it, and the object as scanned."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.camera import Camera
from aomgen.core.clock import Clock
from aomgen.core.gaussians import Gaussians
from aomgen.core.joint_log import JointLog
from aomgen.core.part_points import spread_points, surface_points
from aomgen.core.values import Array, freeze_arrays
from aomgen.io.video import Video
from aomgen.robots.robot import RobotModel


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionInput:
    """What AOMotion looks at.

    Attributes:
        video: The fixed camera's video.
        camera: Its pose and intrinsics, world frame.
        log: The robot's joint log on the video's clock.
        robot: Kinematics, meshes and finger pads.
        scene: The scene as scanned, world frame.
        labels: Part label of every Gaussian of the scene (G,), see `conventions`.
        clock: How the log was brought there.
    """

    video: Video
    camera: Camera
    log: JointLog
    robot: RobotModel
    scene: Annotated[Gaussians, "N"]
    labels: Annotated[NDArray[np.uint8], "N"]
    clock: Clock

    __post_init__ = freeze_arrays

    def ee_poses_at(self, times_s: ArrayLike) -> Array:
        """End-effector poses (T, 4, 4), world frame, at video times (T,)."""
        return np.asarray(self.robot.ee_poses(self.log.at(times_s)[0]), np.float64)

    @property
    def points_moving(self) -> Array:
        """Points of the moving part at its scanned place (N, 3), world frame, [m]."""
        return surface_points(self.scene, self.labels, MOVING)

    @property
    def points_static(self) -> Array:
        """Points of the standing part (M, 3), world frame, [m]."""
        return surface_points(self.scene, self.labels, STATIC)

    @property
    def points_other(self) -> Array:
        """Points of everything else but the robot (K, 3), world frame, [m]."""
        return surface_points(self.scene, self.labels, BACKGROUND)

    def surface_moving(self, spacing_m: float) -> Array:
        """Points of the moving part (N, 3) that leave no gaps along thin things, world frame, [m]."""
        return spread_points(self.scene, self.labels, MOVING, spacing_m)
