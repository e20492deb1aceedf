"""Cameras and kinematics of a suite as plain numbers, which are stored in the settings of a trained policy."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from scipy.linalg import logm
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.transforms import invert
from aomgen.evaluation.suite import open_suite
from aomgen.robots.robot import RobotModel
from lerobot_policy_aomgen.lifting import Views

# Value of all joints at which the pose of a mounted camera relative to the end effector is compared with that at zero, [rad] or
# [m].
PROBE = 0.3


class Geometry(TypedDict):
    """Cameras, by name in the order of the policy's images, and kinematics of the arm.

    Attributes:
        size: Width and height of all images, [px].
        K: Intrinsic matrix (3, 3) of each camera, [px].
        T_frame_cam: Pose (4, 4) of each camera, in the world frame or, if it is mounted, in the end effector frame.
        mounted: Names of the cameras that are mounted on the end effector.
        screws: Twist (4, 4) of each joint at joint values of zero, world frame.
        T_world_ee: Pose (4, 4) of the end effector at joint values of zero.
    """

    size: tuple[int, int]
    K: dict[str, list[list[float]]]
    T_frame_cam: dict[str, list[list[float]]]
    mounted: list[str]
    screws: list[list[list[float]]]
    T_world_ee: list[list[float]]


def read_geometry(path: Path, cameras: list[str]) -> Geometry:
    """Read the geometry of a suite.

    Args:
        path: File of the suite.
        cameras: Names of the cameras to use; empty uses all cameras of the suite.

    Raises:
        AomgenError: See `open_suite`.
        ValueError: A camera is unknown, or there are fewer than two, which is too few to triangulate a point.
    """
    suite, results = open_suite(path)
    unknown = set(cameras) - set(suite.cameras)
    if unknown:
        raise ValueError(f"cameras {sorted(unknown)} are unknown (known: {', '.join(suite.cameras)})")
    chosen = {name: suite.cameras[name] for name in cameras or suite.cameras}
    if len(chosen) < 2:
        raise ValueError(f"{len(chosen)} camera cannot locate a point, two or more are needed")
    return describe_geometry(chosen, results.robot)


def describe_geometry(cameras: Mapping[str, Camera], robot: RobotModel) -> Geometry:
    """Describe cameras and the kinematics of an arm.

    The kinematics are a product of exponentials: `T_world_ee(q) = exp(S_1 q_1) ... exp(S_J q_J) T_world_ee(0)`.

    Args:
        cameras: Cameras by name; poses of mounted cameras are ignored.
        robot: Robot, which may have mounted cameras.

    Raises:
        ValueError: A mounted camera moves relative to the end effector, or images have different sizes.
    """
    count = len(robot.joint_names)
    Ts = robot.ee_poses(np.vstack([np.zeros(count), np.eye(count)]))
    T_frame_cam = {name: camera.T_world_cam for name, camera in cameras.items()}
    mounted = [name for name in cameras if name in robot.cameras]
    for name in mounted:
        joints = np.stack([np.zeros(count), np.full(count, PROBE)])
        T_ee_cam = invert(robot.ee_poses(joints)) @ _camera_poses(robot, name, joints)
        if not np.allclose(T_ee_cam[0], T_ee_cam[1], atol=1e-6):
            raise ValueError(f"the camera {name} moves relative to the end effector")
        T_frame_cam[name] = T_ee_cam[0]
    sizes = {(camera.width, camera.height) for camera in cameras.values()}
    if len(sizes) != 1:
        raise ValueError(f"cameras have different sizes: {sorted(sizes)}")
    return Geometry(
        size=sizes.pop(),
        K={name: camera.K.tolist() for name, camera in cameras.items()},
        T_frame_cam={name: T.tolist() for name, T in T_frame_cam.items()},
        mounted=mounted,
        screws=[np.real(logm(T @ invert(Ts[0]))).tolist() for T in Ts[1:]],
        T_world_ee=Ts[0].tolist(),
    )


def place_cameras(geometry: Geometry, cameras: Mapping[str, Camera]) -> None:
    """Set the intrinsic parameters of a geometry's cameras, and the poses of those that are not mounted on the robot."""
    for name in geometry["K"]:
        geometry["K"][name] = cameras[name].K.tolist()
        if name not in geometry["mounted"]:
            geometry["T_frame_cam"][name] = cameras[name].T_world_cam.tolist()


def _camera_poses(robot: RobotModel, name: str, joints: Any) -> Any:
    return robot.camera_paths(joints, np.zeros(len(joints)))[name].Ts_world_cam


def pose_end_effector(geometry: Geometry, joints: Tensor) -> Tensor:
    """Compute the poses T_world_ee (B, 4, 4) for joints (B, J), [rad] or [m]."""
    screws = torch.tensor(geometry["screws"], dtype=joints.dtype, device=joints.device)
    T = torch.tensor(geometry["T_world_ee"], dtype=joints.dtype, device=joints.device)
    for number in reversed(range(len(screws))):
        T = torch.linalg.matrix_exp(screws[number] * joints[:, number, None, None]) @ T
    return T


def pose_views(geometry: Geometry, cameras: list[str], T_world_ee: Tensor) -> Views:
    """Compute the views of C cameras, given by name, for end effector poses (B, 4, 4)."""
    options = {"dtype": T_world_ee.dtype, "device": T_world_ee.device}
    poses = []
    for name in cameras:
        T = torch.tensor(geometry["T_frame_cam"][name], **options)
        poses.append(T_world_ee @ T if name in geometry["mounted"] else T.expand_as(T_world_ee))
    K = torch.tensor([geometry["K"][name] for name in cameras], **options)
    return Views(geometry["size"], K, torch.stack(poses, 1))


def disturb_poses(Ts: Tensor, sigma_m: float, sigma_rad: float) -> Tensor:
    """Translate and rotate poses (B, 4, 4) in their own frames by normally distributed twists.

    `sigma_m` and `sigma_rad` are the standard deviations of each component.
    """
    twists = Ts.new_zeros(len(Ts), 4, 4)
    x, y, z = (sigma_rad * torch.randn(3, len(Ts), dtype=Ts.dtype, device=Ts.device)).unbind()
    twists[:, 0, 1], twists[:, 1, 0] = -z, z
    twists[:, 0, 2], twists[:, 2, 0] = y, -y
    twists[:, 1, 2], twists[:, 2, 1] = -x, x
    twists[:, :3, 3] = sigma_m * torch.randn(len(Ts), 3, dtype=Ts.dtype, device=Ts.device)
    return Ts @ torch.linalg.matrix_exp(twists)
