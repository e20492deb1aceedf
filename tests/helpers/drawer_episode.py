"""An episode of a drawer that opens, whose end effector stays at the world's origin."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from aomgen.core.camera import Camera, look_at
from aomgen.core.episode import ContactLog, Episode
from aomgen.core.joint import Joint


def corner_camera(width: int, height: int) -> Camera:
    """Create a camera that looks from (1, 1, 1) at the origin."""
    T_world_cam = look_at((1, 1, 1), (0, 0, 0))
    return Camera(
        fx=90, fy=90, cx=width / 2, cy=height / 2, width=width, height=height, T_world_cam=T_world_cam
    )


def drawer_episode(
    index: int,
    joints: np.ndarray,
    thetas: np.ndarray,
    cameras: Mapping[str, Camera],
    verdict: Mapping[str, Any],
    simulation: Mapping[str, Any],
) -> Episode:
    """Create the episode; the actions are the joints of the arm (T, 6)."""
    frames = len(joints)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    return Episode(
        index=index,
        seed=0,
        instruction="open the drawer",
        robot="ur5e_2f85",
        asset="drawer-1",
        asset_usd="asset.usda",
        joint_names=tuple("abcdef"),
        fps=10,
        times_s=np.arange(frames) / 10,
        joints=joints,
        gripper=np.zeros(frames),
        action_joints=joints,
        action_gripper=np.zeros(frames),
        Ts_world_ee=poses,
        Ts_world_ee_action=poses,
        thetas=thetas,
        phases=np.zeros(frames, np.int64),
        contacts=no_contacts(),
        joint=Joint(type="prismatic", axis=(0, -1, 0), origin=(0, 0, 0), lower=0, upper=0.3),
        T_world_object=np.eye(4),
        keypoints=np.zeros((5, 3)),
        cameras=cameras,
        visible={name: np.ones((frames, 5), bool) for name in cameras},
        verdict=verdict,
        simulation=simulation,
    )


def no_contacts() -> ContactLog:
    """Create a log without contacts."""
    none = np.zeros(0, np.int64)
    return ContactLog(
        frames=none,
        fingers=none,
        points_world=np.zeros((0, 3)),
        normals_world=np.zeros((0, 3)),
        forces=np.zeros(0),
    )
