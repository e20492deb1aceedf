import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from aomgen.core.transforms import apply
from aomgen.datasets.features import (
    column_statistics,
    ee_deltas,
    ee_targets,
    feature_columns,
    image_statistics,
)
from aomgen.datasets.lerobot_v3 import assign_files, write_lerobot_v3
from aomgen.errors import ConfigError, MissingFileError
from aomgen.io.episode_folder import color_counts, commit_episode
from aomgen.io.video import concatenate_videos, encode_video, read_video
from small_episodes import FPS, commit, make_episode, make_frames


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> list[Path]:
    root = tmp_path_factory.mktemp("episodes")
    return [commit(root, index, frames) for index, frames in enumerate((12, 9, 15))]


@pytest.fixture(scope="module")
def dataset(folders, tmp_path_factory) -> Path:
    dataset = tmp_path_factory.mktemp("out") / "dataset"
    write_lerobot_v3(folders, dataset)
    return dataset


def test_counts_and_indices_of_a_dataset(dataset):
    info = json.loads((dataset / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"]) == ("v3.0", 3, 36)
    assert info["total_tasks"] == 2
    table = pq.read_table(dataset / "data/chunk-000/file-000.parquet")
    assert table["index"].to_pylist() == list(range(36))
    assert table["episode_index"].to_pylist() == [0] * 12 + [1] * 9 + [2] * 15
    assert table["frame_index"].to_pylist() == [*range(12), *range(9), *range(15)]
    assert set(table["task_index"].to_pylist()[21:]) == {1}
    for name, feature in info["features"].items():
        if feature["dtype"] != "video":
            kind = table.schema.field(name).type
            assert (getattr(kind, "list_size", 1)) == feature["shape"][0], name


def test_values_survive(dataset):
    table = pq.read_table(dataset / "data/chunk-000/file-000.parquet")
    state = np.array(table["observation.state"].to_pylist())[12:21]
    episode = make_episode(1, 9)
    np.testing.assert_allclose(state, np.column_stack([episode.joints, episode.gripper]), atol=1e-6)


def test_every_frame_of_the_joined_video_is_the_right_one(dataset):
    video = read_video(dataset / "videos/observation.images.side/chunk-000/file-000.mp4")
    want = np.concatenate([make_frames(i, n, 1)[:, 0, 0, 0] for i, n in enumerate((12, 9, 15))]).astype(float)
    got = video.frames_srgb.mean((1, 2, 3))
    assert len(got) == 36
    np.testing.assert_allclose(got, want, atol=2)
    rows = pq.read_table(dataset / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for row in rows:
        start = row["videos/observation.images.side/from_timestamp"]
        assert start == pytest.approx(row["dataset_from_index"] / FPS)
        np.testing.assert_allclose(video.times_s[row["dataset_from_index"]], start, atol=1e-4)


def test_same_episodes_give_the_same_bytes(folders, dataset, tmp_path):
    again = tmp_path / "again"
    write_lerobot_v3(folders, again)
    files = sorted(p.relative_to(dataset) for p in dataset.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
    for name in files:
        assert (dataset / name).read_bytes() == (again / name).read_bytes(), name


def test_rebuilding_replaces_an_old_dataset(folders, tmp_path):
    target = tmp_path / "dataset"
    write_lerobot_v3(folders, target)
    write_lerobot_v3(folders[:1], target)
    assert json.loads((target / "meta/info.json").read_text())["total_episodes"] == 1
    assert [p.name for p in tmp_path.iterdir()] == ["dataset"]


def test_statistics_of_columns_and_pictures():
    values = np.random.default_rng(0).normal(2.0, 3.0, (20_000, 2))
    found = column_statistics(values)
    np.testing.assert_allclose(found["mean"], [2, 2], atol=0.1)
    np.testing.assert_allclose(found["q99"], [2 + 3 * 2.326] * 2, atol=0.25)
    frames = np.random.default_rng(0).integers(0, 256, (4, 16, 16, 3), dtype=np.uint8)
    image = image_statistics(color_counts(frames), 4)
    direct = frames.reshape(-1, 3) / 255
    np.testing.assert_allclose(np.ravel(image["mean"]), direct.mean(0), atol=1e-9)
    np.testing.assert_allclose(np.ravel(image["std"]), direct.std(0), atol=1e-9)
    np.testing.assert_allclose(np.ravel(image["max"]), direct.max(0), atol=1e-9)
    assert np.shape(image["q50"]) == (3, 1, 1)
    assert image["count"] == [4]


def test_only_state_and_pictures_go_in_and_only_actions_come_out():
    names = feature_columns(make_episode(0, 9))
    assert [name for name in names if name.startswith("observation")] == ["observation.state"]
    assert [name for name in names if name.startswith("action")] == ["action"]
    assert all(name.startswith("annotation.") for name in list(names)[2:])


def test_deltas_add_up_to_the_path_of_the_targets_wherever_the_arm_is():
    episode = make_episode(0, 60)
    T = episode.Ts_world_ee[:1]
    for delta, target in zip(
        feature_columns(episode)["annotation.action.ee_delta"], episode.Ts_world_ee_action, strict=True
    ):
        T = ee_targets(T, delta[None])
        np.testing.assert_allclose(T[0], target, atol=1e-9)


def test_a_delta_is_undone_by_the_pose_that_it_counts_from():
    path = make_episode(0, 60).Ts_world_ee
    np.testing.assert_allclose(ee_targets(path[:-1], ee_deltas(path[:-1], path[1:])), path[1:], atol=1e-9)


def test_quaternions_do_not_jump_and_forces_stand_at_their_frame():
    columns = feature_columns(make_episode(0, 60))
    quats = columns["annotation.ee_pose"][:, 3:]
    assert np.abs(np.diff(quats, axis=0)).max() < 0.1
    assert columns["annotation.finger_force"][3].tolist() == [0, 4]


def test_keypoints_move_with_the_part_and_are_projected_into_every_camera():
    episode = make_episode(0, 60)
    columns = feature_columns(episode)
    points = columns["annotation.keypoints"].reshape(60, 5, 3)
    moved = apply(episode.joint.motion(episode.thetas[30]), episode.keypoints[:3])
    np.testing.assert_allclose(points[30, :3], moved)
    np.testing.assert_allclose(points[:, 3:], np.tile(episode.keypoints[3:], (60, 1, 1)))
    shown = columns["annotation.keypoints_px.side"].reshape(60, 5, 3)
    np.testing.assert_allclose(shown[30, :, :2], episode.cameras["side"].project(points[30])[0])
    np.testing.assert_array_equal(shown[..., 2], episode.visible["side"])


def test_files_roll_at_the_limit():
    assert assign_files([4, 4, 4, 20, 1], 10) == [0, 0, 1, 2, 3]


def test_no_episode_is_refused(tmp_path):
    with pytest.raises(MissingFileError, match="no episode"):
        write_lerobot_v3([], tmp_path / "dataset")


def test_unlike_episodes_are_refused_and_nothing_is_left(folders, tmp_path):
    other = commit(tmp_path / "episodes", 7, 9, cameras=("front",))
    with pytest.raises(ConfigError, match="cameras"):
        write_lerobot_v3([folders[0], other], tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()


def test_the_dataset_of_av1_videos_says_so(tmp_path):
    episode = make_episode(0, 6, cameras=("front",))
    frames = make_frames(0, 6)
    folder = commit_episode(
        tmp_path / "e", episode, {"front": encode_video(frames, FPS, codec="av1")}, codec="av1"
    )
    write_lerobot_v3([folder], tmp_path / "dataset")
    info = json.loads((tmp_path / "dataset/meta/info.json").read_text())
    assert info["features"]["observation.images.front"]["info"]["video.codec"] == "av1"
    joined = read_video(tmp_path / "dataset/videos/observation.images.front/chunk-000/file-000.mp4")
    assert np.abs(joined.frames_srgb.astype(int) - frames).max() < 6
    with pytest.raises(ConfigError, match="codec"):
        write_lerobot_v3([folder, commit(tmp_path / "e", 1, 6, cameras=("front",))], tmp_path / "mixed")


def test_joining_needs_every_video(tmp_path):
    with pytest.raises(MissingFileError):
        concatenate_videos([tmp_path / "none.mp4"], FPS)
