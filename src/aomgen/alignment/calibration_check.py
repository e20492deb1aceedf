"""Comparison of hand-eye calibrations of fixed cameras with their poses from the scan."""

from dataclasses import dataclass

import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.transforms import invert, rotvec_from_matrix
from aomgen.core.values import Array
from aomgen.errors import AlignmentError

# A calibration that shows the robot elsewhere in the image by more than this share of its width is
# not inaccurate but wrong: hand-eye calibrations are good to millimetres, alignments likewise.
_GROSS_SHARE = 0.04
# A known mistake explains a calibration when it takes this share of the deviation away.
_EXPLAINED = 0.75


@dataclass(frozen=True, slots=True, kw_only=True)
class Deviation:
    """How far apart two poses of a camera are."""

    distance_m: float
    angle_rad: float

    def within(self, limit_m: float, limit_rad: float) -> bool:
        """Whether both are within limits; NaN is not."""
        return self.distance_m <= limit_m and self.angle_rad <= limit_rad

    def __str__(self) -> str:
        return f"{1e3 * self.distance_m:.1f} mm, {np.degrees(self.angle_rad):.2f} deg"


def deviation(T_world_cam: Array, camera: Camera) -> Deviation:
    """Between a pose (4, 4) and a camera."""
    turn = rotvec_from_matrix(T_world_cam[:3, :3].T @ camera.T_world_cam[:3, :3])
    return Deviation(
        distance_m=float(np.linalg.norm(T_world_cam[:3, 3] - camera.center)),
        angle_rad=float(np.linalg.norm(turn)),
    )


def refuse_gross(name: str, T_world_cam: Array, camera: Camera, robot_world: Array) -> None:
    """Refuse a calibration that shows the robot where the scan's camera does not.

    Args:
        name: Of the camera.
        T_world_cam: From capture.toml (4, 4).
        camera: As scan and alignment place it, world frame.
        robot_world: Points on the robot (N, 3), [m].

    Raises:
        AlignmentError: With both poses' distance, and the usual mistake that would explain it.
    """
    shift = _shift_share(T_world_cam, camera, robot_world)
    if shift <= _GROSS_SHARE:
        return
    hint = "calibrate again, or leave T_world_cam out"
    for mistake, remedy in _mistakes(T_world_cam):
        if _shift_share(mistake, camera, robot_world) <= (1 - _EXPLAINED) * min(shift, 1.0):
            hint = remedy
    raise AlignmentError(
        f"demo camera '{name}'",
        f"T_world_cam in capture.toml is {deviation(T_world_cam, camera)} from where scan and robot place "
        f"the camera, and shows the robot elsewhere by {shift:.0%} of the picture's width "
        f"(limit {_GROSS_SHARE:.0%})",
        hint,
    )


def _shift_share(T_world_cam: Array, camera: Camera, robot_world: Array) -> float:
    """Median shift of the robot in the image, as share of its width; infinite when it is behind."""
    there, depths = camera.moved(T_world_cam).project(robot_world)
    here, _ = camera.project(robot_world)
    if not np.median(depths) > 0:
        return float("inf")
    return float(np.median(np.linalg.norm(there - here, axis=1))) / camera.width


def _mistakes(T_world_cam: Array) -> list[tuple[Array, str]]:
    """What a calibration would be if it had been written in one of the usual other ways."""
    half_turn, opengl = np.diag([-1.0, -1, 1, 1]), np.diag([1.0, -1, -1, 1])
    return [
        (invert(T_world_cam), "it looks like T_cam_world; write its inverse"),
        (half_turn @ T_world_cam, "it looks like the robot's other base frame; correct robot.base_frame"),
        (T_world_cam @ opengl, "it looks like OpenGL axes; turn them to x right, y down, z forward"),
    ]
