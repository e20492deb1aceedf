"""What AOMotion looks at: a video of the demonstration, the robot's log of it, and the object as scanned."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.camera import Camera
from aomgen.core.clock import Clock
from aomgen.core.gaussians import Gaussians
from aomgen.core.joint_log import JointLog
from aomgen.core.part_points import spread_points, surface_points
from aomgen.core.values import Array, freeze
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
    scene: Gaussians
    labels: NDArray[np.uint8]
    clock: Clock

    def __post_init__(self) -> None:
        freeze(self, "labels", self.labels, (len(self.scene),), np.uint8)

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
