"""Small episodes on disk, whose numbers and images all differ."""

from pathlib import Path

import numpy as np

from aomgen.core.camera import Camera, look_at
from aomgen.core.episode import ContactLog, Episode
from aomgen.core.joint import Joint
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.io.episode_folder import commit_episode
from aomgen.io.video import encode_video

FPS = 10


def make_episode(index: int, frames: int, *, cameras: tuple[str, ...] = ("front", "side")) -> Episode:
    rng = np.random.default_rng(index)
    joints = np.cumsum(rng.normal(0, 0.02, (frames, 6)), 0)
    turn = np.linspace(0, 4, frames)[:, None] * np.array([0, 0, 1.0])
    T_ee = transform(matrix_from_rotvec(turn), rng.normal(size=3) + np.linspace(0, 0.2, frames)[:, None])
    camera = Camera(
        fx=80, fy=80, cx=40, cy=32, width=80, height=64, T_world_cam=look_at((1, 1, 1), (0, 0, 0))
    )
    contact = ContactLog(
        frames=np.array([3]),
        fingers=np.array([1]),
        points_world=np.zeros((1, 3)),
        normals_world=np.array([[0, 0, 1.0]]),
        forces=np.array([4.0]),
    )
    return Episode(
        index=index,
        seed=5,
        instruction="open the microwave" if index != 2 else "open the drawer",
        robot="ur5e_2f85",
        asset="microwave-1",
        asset_usd="asset.usda",
        joint_names=tuple(f"joint_{i}" for i in range(6)),
        fps=FPS,
        times_s=np.arange(frames) / FPS,
        joints=joints,
        gripper=np.linspace(0, 1, frames),
        action_joints=joints + 0.01,
        action_gripper=np.linspace(0, 1, frames),
        Ts_world_ee=T_ee,
        Ts_world_ee_action=T_ee @ transform(np.eye(3), (0.01, 0, 0)),
        thetas=np.linspace(0, 1.2, frames),
        phases=np.zeros(frames, np.int64),
        contacts=contact,
        joint=Joint(type="revolute", axis=(0, 0, -1), origin=(0.4, 0, 0), lower=0, upper=1.6),
        T_world_object=np.eye(4),
        keypoints=rng.normal(0, 0.2, (5, 3)),
        cameras={name: camera for name in cameras},
        visible={name: rng.random((frames, 5)) < 0.7 for name in cameras},
        verdict={"passed": True},
        simulation={"bolted": True},
    )


def make_frames(index: int, frames: int, camera: int = 0) -> np.ndarray:
    """Make frames of uniform gray; the value identifies episode and frame, so that decoding can be checked."""
    levels = 20 + 10 * index + 6 * np.arange(frames) + 80 * camera
    return np.broadcast_to(levels[:, None, None, None], (frames, 64, 80, 3)).astype(np.uint8)


def commit(root: Path, index: int, frames: int, **options: tuple[str, ...]) -> Path:
    episode = make_episode(index, frames, **options)
    videos = {
        name: encode_video(make_frames(index, frames, camera), FPS)
        for camera, name in enumerate(episode.cameras)
    }
    return commit_episode(root, episode, videos)
