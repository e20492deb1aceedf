"""What AOMotion looks at: a film of the demonstration, the robot's log of it, and the object as scanned."""

from dataclasses import dataclass

from aomgen.core.camera import Camera
from aomgen.core.joint_log import JointLog
from aomgen.core.values import Array, freeze
from aomgen.io.video import Video
from aomgen.physics.robot import RobotModel


@dataclass(frozen=True, slots=True, kw_only=True)
class Demonstration:
    """What AOMotion looks at.

    Attributes:
        video: The fixed camera's film.
        camera: Its pose and intrinsics, world frame.
        log: The robot's joint log, own clock.
        robot: Kinematics, meshes and finger pads.
        points_moving: Points of the moving part at its scanned place (N, 3), world frame, [m].
        points_static: Points of the standing part (M, 3), world frame, [m].
        points_other: Points of everything else but the robot (K, 3), world frame, [m].
        clock_offset_s: Log time minus video time.
        clock_sd_s: Its standard deviation, [s].
    """

    video: Video
    camera: Camera
    log: JointLog
    robot: RobotModel
    points_moving: Array
    points_static: Array
    points_other: Array
    clock_offset_s: float
    clock_sd_s: float

    def __post_init__(self) -> None:
        freeze(self, "points_moving", self.points_moving, (None, 3))
        freeze(self, "points_static", self.points_static, (None, 3))
        freeze(self, "points_other", self.points_other, (None, 3))
