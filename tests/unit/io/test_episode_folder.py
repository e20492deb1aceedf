"""What is stored with an episode comes back bit by bit."""

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from aomgen.core.camera import Camera
from aomgen.core.episode import Episode
from aomgen.core.joint import Joint
from aomgen.errors import BackendError, CorruptArtifactError, MalformedFileError
from aomgen.io.episode_folder import color_counts, commit_episode, read_episode, read_images
from aomgen.io.video import encode_video, read_video
from drawer_episode import no_contacts

FRAMES, HEIGHT, WIDTH = 45, 64, 96


@pytest.fixture(scope="module")
def episode() -> Episode:
    Ts = np.tile(np.eye(4), (FRAMES, 1, 1))
    Ts[:, 0, 3] = np.linspace(0, 1, FRAMES)
    camera = Camera(fx=90, fy=90, cx=48, cy=32, width=WIDTH, height=HEIGHT, T_world_cam=np.eye(4))
    row = np.linspace(0, 1, FRAMES)
    return Episode(
        index=3, seed=1, instruction="open it", robot="ur5e_2f85", asset="box", asset_usd="a.usda",
        joint_names=("a", "b"), fps=10, times_s=np.arange(FRAMES) / 10, joints=np.stack([row, row], 1), gripper=row,
        action_joints=np.stack([row, row], 1), action_gripper=row, Ts_world_ee=Ts, Ts_world_ee_action=Ts,
        thetas=row, phases=np.zeros(FRAMES, np.int64), contacts=no_contacts(),
        joint=Joint(type="revolute", axis=(0, 0, 1), origin=(0, 0, 0), lower=0, upper=1),
        T_world_object=np.eye(4), cameras={"front": camera, "wrist": camera}, verdict={}, simulation={},
        keypoints=np.arange(15.0).reshape(5, 3), camera_poses={"wrist": Ts},
        visible={name: np.arange(5 * FRAMES).reshape(FRAMES, 5) % 3 == k for k, name in enumerate(("front", "wrist"))},
    )  # fmt: skip


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    waves = [np.sin(x / 9 + t / 5) + np.cos(y / 7 - t / 8) for t in range(FRAMES)]
    return (127 + 50 * np.stack([waves, np.negative(waves), waves], -1)).astype(np.uint8)


def commit(root: Path, episode: Episode, frames: np.ndarray, **options) -> Path:
    video = encode_video(frames, episode.fps, codec=options.get("codec", "h264"))
    return commit_episode(root, episode, dict.fromkeys(episode.cameras, video), **options)


def test_images_poses_and_colors_come_back(episode, frames, tmp_path):
    rng = np.random.default_rng(0)
    depth = {
        name: rng.integers(0, 65536, (FRAMES, HEIGHT, WIDTH)).astype(np.uint16) for name in episode.cameras
    }
    labels = {name: rng.integers(0, 4, (FRAMES, HEIGHT, WIDTH)).astype(np.uint8) for name in episode.cameras}
    images = {"depth": depth, "labels": labels}
    stored = read_episode(commit(tmp_path / "a", episode, frames, images=images))
    for kind, by_camera in images.items():
        for name, stack in by_camera.items():
            np.testing.assert_array_equal(read_images(stored.images[kind][name]), stack)
            assert f"{name}.{kind}.npz" in stored.sha256
    np.testing.assert_array_equal(stored.episode.camera_poses["wrist"], episode.camera_poses["wrist"])
    assert set(stored.episode.camera_poses) == {"wrist"}
    np.testing.assert_array_equal(stored.episode.keypoints, episode.keypoints)
    for name, shown in episode.visible.items():
        np.testing.assert_array_equal(stored.episode.visible[name], shown)
    # Every second of 45 frames, as the video shows them.
    shown = read_video(stored.videos["front"]).frames_srgb[::2, ::4, ::4]
    np.testing.assert_array_equal(stored.color_counts["front"], color_counts(shown))
    again = commit(tmp_path / "b", episode, frames, images=images)
    for path in stored.folder.iterdir():
        assert path.read_bytes() == (again / path.name).read_bytes()


def test_damaged_images_are_noticed(episode, frames, tmp_path):
    depth = dict.fromkeys(episode.cameras, np.full((FRAMES, HEIGHT, WIDTH), 900, np.uint16))
    folder = commit(tmp_path, episode, frames, images={"depth": depth})
    with pytest.raises(MalformedFileError, match="holds no images"):
        read_images(folder / "frames.npz")
    (folder / "front.depth.npz").unlink()
    with pytest.raises(CorruptArtifactError, match="missing"):
        read_episode(folder)


def test_a_video_that_lacks_a_frame_is_not_committed(episode, frames, tmp_path):
    with pytest.raises(CorruptArtifactError, match="has 44 frames, the episode 45"):
        commit(tmp_path, episode, frames[:-1])
    assert not list(tmp_path.iterdir())


def test_poses_need_a_camera_and_every_frame(episode):
    for poses in ({"top": episode.camera_poses["wrist"]}, {"wrist": np.eye(4)[None]}):
        with pytest.raises(ValueError, match="camera_poses"):
            replace(episode, camera_poses=poses)


def test_both_codecs_keep_the_pictures_and_give_the_same_bytes_again(episode, frames, tmp_path):
    for codec in ("h264", "av1"):
        video = encode_video(frames, 10, codec=codec)
        assert video == encode_video(frames, 10, codec=codec)
        stored = read_episode(commit(tmp_path / codec, episode, frames, codec=codec))
        assert stored.codec == codec
        error = read_video(stored.videos["front"]).frames_srgb.astype(float) - frames
        assert np.sqrt(np.mean(error**2)) < 4


def test_a_missing_encoder_is_named(frames, monkeypatch):
    monkeypatch.setattr(av, "codecs_available", set())
    with pytest.raises(BackendError, match="libsvtav1"):
        encode_video(frames, 10, codec="av1")
