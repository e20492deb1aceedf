"""All formats: round trips by `audit`, equal bytes, splits, and what is refused."""

import json
import shutil
from itertools import accumulate
from pathlib import Path

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest

from aomgen.core.keypoints import move_keypoints
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.datasets.audit import audit_dataset
from aomgen.datasets.features import ACTION_SPACES
from aomgen.datasets.formats import FORMATS, export_dataset
from aomgen.datasets.lerobot_v3 import DATA_PATH, EPISODES_PATH
from aomgen.datasets.lerobot_v21 import VIDEO_PATH
from aomgen.datasets.rlds import openvla_columns, rpy_from_matrix
from aomgen.datasets.robomimic import FILE, scale_actions, unscale_actions
from aomgen.datasets.selection import chosen_space, default_val, spread
from aomgen.errors import ConfigError, CorruptArtifactError, MalformedFileError, MissingFileError
from small_episodes import commit, make_episode

LENGTHS = (12, 9, 15, 8)
LEROBOT = ("lerobot-v3", "lerobot-v2.1")


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> list[Path]:
    root = tmp_path_factory.mktemp("episodes")
    return [commit(root, index, frames) for index, frames in enumerate(LENGTHS)]


@pytest.fixture(scope="module")
def exported(folders, tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("out")
    made = {kind: root / kind.replace("-", "_").replace(".", "") for kind in FORMATS}
    for kind, dataset in made.items():
        export_dataset(folders, dataset, kind)
    return made


def files(folder: Path) -> dict[Path, bytes]:
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def copy(dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dataset, tmp_path / dataset.name))


CHOICES = [
    ("lerobot-v3", {}),
    ("lerobot-v3", {"actions": "ee_delta", "media": "image", "val": 1}),
    ("lerobot-v3", {"media": "image", "size": "40x30"}),
    ("lerobot-v3", {"size": "40x30", "val": 2}),
    ("lerobot-v3", {"media": "none", "val": 1}),
    ("lerobot-v2.1", {}),
    ("lerobot-v2.1", {"media": "none"}),
    ("lerobot-v2.1", {"actions": "ee_absolute", "media": "image", "size": "40x30", "val": 1}),
    ("lerobot-v2.1", {"size": "40x30"}),
    ("rlds", {}),
    ("rlds", {"actions": "joint", "size": "40x30", "val": 3}),
    ("rlds-array-record", {"size": "40x30"}),
    ("hdf5", {}),
    ("hdf5", {"actions": "ee_delta", "size": "40x30", "val": 2}),
]


@pytest.mark.parametrize(("kind", "options"), CHOICES)
def test_what_is_written_is_read_back(folders, tmp_path, kind, options):
    selection = export_dataset(folders, tmp_path / "dataset", kind, **options)
    found = audit_dataset(tmp_path / "dataset", folders)
    assert found.faults == []
    assert found.actions == options.get("actions", "ee_delta" if kind.startswith("rlds") else "joint")
    val = options.get("val", 0 if kind in LEROBOT else 1)
    assert (len(selection.train), len(selection.val)) == (4 - val, val)
    assert found.splits == {"train": 4 - val} | ({"val": val} if val else {})
    assert found.frames == sum(LENGTHS)


@pytest.mark.parametrize("kind", LEROBOT)
def test_without_pictures_policies_are_told_where_the_object_stands(folders, tmp_path, kind):
    export_dataset(folders, tmp_path / "told", kind, media="none")
    features = json.loads((tmp_path / "told" / "meta" / "info.json").read_text())["features"]
    assert features["observation.environment_state"]["shape"] == [7]
    assert not [name for name in features if "images" in name or name == "annotation.object_pose"]
    for found in FORMATS[kind].read(tmp_path / "told").episodes:
        episode = make_episode(found.source_index, LENGTHS[found.source_index])
        poses = found.columns["annotation.object_pose"]
        assert np.abs(poses[:, :3] - episode.T_world_object[:3, 3]).max() < 1e-6
        assert (poses == poses[0]).all()


@pytest.mark.parametrize("kind", LEROBOT)
def test_without_images_policies_can_observe_the_keypoints(folders, tmp_path, kind):
    export_dataset(folders, tmp_path / "told", kind, media="keypoints")
    features = json.loads((tmp_path / "told" / "meta" / "info.json").read_text())["features"]
    assert features["observation.environment_state"]["shape"] == [15]
    assert not [name for name in features if "images" in name or name == "annotation.keypoints"]
    for found in FORMATS[kind].read(tmp_path / "told").episodes:
        episode = make_episode(found.source_index, LENGTHS[found.source_index])
        points = move_keypoints(episode.keypoints, episode.joint, episode.thetas)
        assert found.columns["annotation.keypoints"] == pytest.approx(
            points.reshape(len(episode), 15), abs=1e-6
        )
    assert audit_dataset(tmp_path / "told", folders).faults == []


@pytest.mark.parametrize("kind", FORMATS)
def test_same_episodes_give_the_same_bytes(folders, exported, tmp_path, kind):
    again = tmp_path / exported[kind].name
    export_dataset(folders, again, kind)
    assert files(again) == files(exported[kind])


@pytest.mark.parametrize("kind", FORMATS)
def test_deltas_add_up_to_the_path(exported, folders, kind):
    """In the precision of the dataset, to less than a millimetre and a thousandth of a radian."""
    dataset = exported[kind]
    for found, length in zip(FORMATS[kind].read(dataset).episodes, LENGTHS, strict=False):
        episode = make_episode(found.source_index, LENGTHS[found.source_index])
        if kind.startswith("rlds"):
            delta = found.columns["action"]
            roll, pitch, yaw = (matrix_from_rotvec(delta[:, 3 + i : 4 + i] * np.eye(3)[i]) for i in range(3))
            turns = list(
                accumulate(
                    yaw @ pitch @ roll, lambda R, turn: turn @ R, initial=episode.Ts_world_ee[0, :3, :3]
                )
            )
            places = episode.Ts_world_ee[0, :3, 3] + np.cumsum(delta[:, :3], 0)
            reached = transform(np.array(turns[1:]), places)
        else:
            delta = found.columns["annotation.action.ee_delta"]
            steps = transform(matrix_from_rotvec(delta[:, 3:6]), delta[:, :3])
            reached = np.array(list(accumulate(steps, np.matmul, initial=episode.Ts_world_ee[0]))[1:])
        off = np.abs(reached - episode.Ts_world_ee_action)
        assert off[:, :3, 3].max() < 1e-3
        assert off[:, :3, :3].max() < 1e-3
        assert length


def test_openvla_has_eight_numbers_of_state_and_an_open_gripper_is_one():
    episode = make_episode(0, 12)
    columns = openvla_columns(episode)
    assert columns["observation.state"].shape == (12, 8)
    np.testing.assert_array_equal(columns["observation.state"][:, :6], episode.joints)
    assert np.all(columns["observation.state"][:, 6] == 0)
    np.testing.assert_allclose(columns["observation.state"][:, 7], 1 - episode.gripper)
    assert columns["action"].shape == (12, 7)
    np.testing.assert_allclose(columns["action"][:, 6], 1 - episode.action_gripper)


def test_roll_pitch_and_yaw_of_a_rotation():
    rng = np.random.default_rng(3)
    angles = rng.uniform((-3, -1.5, -3), (3, 1.5, 3), (50, 3))
    x, y, z = (matrix_from_rotvec(angles[:, i : i + 1] * np.eye(3)[i]) for i in range(3))
    np.testing.assert_allclose(rpy_from_matrix(z @ y @ x), angles, atol=1e-9)


def test_scaled_actions_fill_the_range_and_come_back():
    actions = np.random.default_rng(0).normal(size=(40, 4)) * [1, 10, 0.01, 0] + 3
    lower, upper = actions.min(0), actions.max(0)
    scaled = scale_actions(actions, lower, upper)
    np.testing.assert_allclose(scaled.min(0), [-1, -1, -1, 0], atol=1e-9)
    np.testing.assert_allclose(scaled.max(0), [1, 1, 1, 0], atol=1e-9)
    np.testing.assert_allclose(unscale_actions(scaled, lower, upper), actions, atol=1e-12)


def test_the_layout_of_robomimic(exported):
    with h5py.File(exported["hdf5"] / FILE) as file:
        assert file["data"].attrs["total"] == sum(LENGTHS)
        assert json.loads(file["data"].attrs["env_args"])["env_name"] == "aomgen/Open-v0"
        masks = {name: [item.decode() for item in file["mask"][name]] for name in ("train", "valid")}
        assert masks == {"train": ["demo_0", "demo_1", "demo_2"], "valid": ["demo_3"]}
        demo = file["data/demo_1"]
        assert demo.attrs["num_samples"] == len(demo["actions"]) == len(demo["states"])
        assert np.abs(demo["actions"]).max() <= 1
        for name in demo["obs"]:
            np.testing.assert_array_equal(demo["next_obs"][name][:-1], demo["obs"][name][1:])
            np.testing.assert_array_equal(demo["next_obs"][name][-1], demo["obs"][name][-1])
        assert (
            demo["rewards"][:].tolist() == demo["dones"][:].tolist() == [0] * (len(demo["dones"]) - 1) + [1]
        )


def test_the_layout_of_lerobot_21(exported):
    dataset = exported["lerobot-v2.1"]
    info = json.loads((dataset / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_videos"], info["total_chunks"]) == ("v2.1", 8, 1)
    for number, length in enumerate(LENGTHS):
        where = {"episode_chunk": 0, "episode_index": number}
        assert pq.read_table(dataset / info["data_path"].format(**where)).num_rows == length
        assert (dataset / VIDEO_PATH.format(video_key="observation.images.side", **where)).is_file()
    lines = (dataset / "meta/episodes_stats.jsonl").read_text().splitlines()
    statistics = json.loads(lines[2])["stats"]
    assert set(statistics) == set(info["features"])
    assert set(statistics["action"]) == {"min", "max", "mean", "std", "count"}
    assert np.shape(statistics["observation.images.front"]["mean"]) == (3, 1, 1)


def test_validation_is_spread_over_the_episodes():
    assert spread(60, 6) == {5, 15, 25, 35, 45, 55}
    assert spread(3, 0) == set()
    for count in range(1, 40):
        for wanted in range(count):
            assert len(spread(count, wanted)) == wanted
    assert [default_val(count) for count in (2, 14, 16, 300)] == [1, 1, 2, 30]


def test_a_dataset_of_ours_is_replaced_and_a_foreign_folder_is_not(folders, exported, tmp_path):
    target = copy(exported["rlds"], tmp_path)
    export_dataset(folders, target, "lerobot-v2.1")
    assert audit_dataset(target, folders).faults == []
    foreign = tmp_path / "thesis"
    foreign.mkdir()
    export_dataset(folders, foreign, "lerobot-v3")
    shutil.rmtree(foreign)
    (foreign / "meta").mkdir(parents=True)
    (foreign / "meta" / "info.json").write_text("{}")
    with pytest.raises(ConfigError, match="not written by AOMGen"):
        export_dataset(folders, foreign, "lerobot-v3")
    file = tmp_path / "notes"
    file.write_text("mine")
    with pytest.raises(ConfigError, match="not written by AOMGen"):
        export_dataset(folders, file, "lerobot-v3")
    assert [p.name for p in foreign.rglob("*")] == ["meta", "info.json"]
    assert file.read_text() == "mine"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["notes", "rlds", "thesis"]


@pytest.mark.parametrize(
    ("kind", "options", "words"),
    [
        ("lerobot", {}, "did you mean 'lerobot-v3'"),
        ("zarr", {}, "known: lerobot-v3, lerobot-v2.1, rlds, rlds-array-record, hdf5"),
        ("rlds", {"media": "image"}, "no meaning for rlds"),
        ("hdf5", {"actions": "ee"}, "'ee' is unknown"),
        ("lerobot-v3", {"media": "gif"}, "'gif' is unknown"),
        ("hdf5", {"size": "big"}, "'big' is not WxH"),
        ("hdf5", {"size": "0x64"}, "'0x64' is not WxH"),
        ("hdf5", {"size": "64x"}, "'64x' is not WxH"),
        ("rlds", {"size": "81x64"}, "larger than what camera 'front' rendered, 80x64"),
        ("lerobot-v3", {"size": "33x30"}, "33x30 is odd"),
        ("lerobot-v2.1", {"size": "32x31"}, "32x31 is odd"),
        ("lerobot-v3", {"val": 4}, "4 of 4 episodes leaves none"),
        ("lerobot-v3", {"val": -1}, "-1 of 4"),
        ("rlds", {"val": 9}, "9 of 4 episodes leaves none"),
        ("rlds", {"val": 0}, "val split"),
        ("hdf5", {"val": 0}, "is 0"),
    ],
)
def test_wrong_options_are_refused_and_nothing_is_written(folders, tmp_path, kind, options, words):
    with pytest.raises(ConfigError, match=words):
        export_dataset(folders, tmp_path / "dataset", kind, **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["rlds", "hdf5"])
def test_one_episode_cannot_be_split(folders, tmp_path, kind):
    with pytest.raises(ConfigError, match="1 of 1 episodes leaves none to train on"):
        export_dataset(folders[:1], tmp_path / "dataset", kind)


def test_a_name_that_tfds_does_not_take_is_refused(folders, tmp_path):
    with pytest.raises(ConfigError, match="not a valid name for TFDS"):
        export_dataset(folders, tmp_path / "my-data", "rlds")


@pytest.mark.parametrize("kind", FORMATS)
def test_no_episode_is_refused(tmp_path, kind):
    with pytest.raises(MissingFileError, match="no episode"):
        export_dataset([], tmp_path / "dataset", kind)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_damaged_episode_stops_the_export(folders, tmp_path, kind):
    for folder in folders[:2]:
        copy(folder, tmp_path)
    video = tmp_path / folders[0].name / "side.mp4"
    video.write_bytes(video.read_bytes()[:-9])
    with pytest.raises(CorruptArtifactError, match="digest"):
        export_dataset([tmp_path / folder.name for folder in folders[:2]], tmp_path / "dataset", kind)
    assert not (tmp_path / "dataset").exists()


@pytest.mark.parametrize("version", ["v1.6", "v2.0", "v9.9", None])
@pytest.mark.parametrize("kind", LEROBOT)
def test_another_version_of_lerobot_is_named(exported, folders, tmp_path, kind, version):
    dataset = copy(exported[kind], tmp_path)
    info = json.loads((dataset / "meta/info.json").read_text())
    (dataset / "meta/info.json").write_text(json.dumps(info | {"codebase_version": version}))
    with pytest.raises(MalformedFileError, match=rf"codebase_version {version!r}, known are v2.1 and v3.0"):
        audit_dataset(dataset, folders)


def without_feature(dataset: Path, kind: str) -> None:
    """Take `annotation.ee_pose` out of a dataset."""
    name = "annotation.ee_pose"
    if kind == "hdf5":
        with h5py.File(dataset / FILE, "a") as file:
            del file["data/demo_1/annotation/ee_pose"]
    elif kind.startswith("rlds"):
        path = dataset / "1.0.0/features.json"
        content = json.loads(path.read_text())
        steps = content["featuresDict"]["features"]["steps"]["sequence"]["feature"]["featuresDict"]
        del steps["features"]["annotation"]["featuresDict"]["features"]["ee_pose"]
        path.write_text(json.dumps(content))
    else:
        path = next((dataset / "data").rglob("*.parquet"))
        pq.write_table(pq.read_table(path).drop([name]), path)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_missing_feature_is_named(exported, folders, tmp_path, kind):
    dataset = copy(exported[kind], tmp_path)
    without_feature(dataset, kind)
    with pytest.raises(MalformedFileError, match=r"lacks .*ee_pose"):
        audit_dataset(dataset, folders)


def test_two_action_spaces_without_a_note_are_ambiguous(exported, folders, tmp_path):
    dataset = copy(exported["lerobot-v3"], tmp_path)
    path = dataset / "meta/info.json"
    info = json.loads(path.read_text())
    del info["features"]["annotation.action.ee_delta"]
    path.write_text(json.dumps(info))
    said = r"lacks annotation\.action\.joint and annotation\.action\.ee_delta; only the space of `action` may be missing"
    with pytest.raises(MalformedFileError, match=said):
        audit_dataset(dataset, folders)
    every = {f"annotation.action.{space}" for space in ACTION_SPACES}
    with pytest.raises(MalformedFileError, match="`action` has no space"):
        chosen_space(dict.fromkeys(every), path)


@pytest.mark.parametrize(
    ("kind", "pattern"),
    [
        ("lerobot-v3", "data/**/*.parquet"),
        ("lerobot-v3", "meta/tasks.parquet"),
        ("lerobot-v3", "meta/episodes/**/*.parquet"),
        ("lerobot-v3", "videos/**/*.mp4"),
        ("lerobot-v2.1", "data/**/*.parquet"),
        ("lerobot-v2.1", "videos/**/*.mp4"),
        ("lerobot-v2.1", "meta/info.json"),
        ("lerobot-v2.1", "meta/episodes.jsonl"),
        ("lerobot-v2.1", "meta/tasks.jsonl"),
        ("rlds", "1.0.0/*train*"),
        ("rlds", "1.0.0/*val*"),
        ("rlds-array-record", "1.0.0/*train*"),
        ("rlds", "1.0.0/dataset_info.json"),
        ("hdf5", "*.hdf5"),
    ],
)
@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_a_cut_file_is_refused(exported, folders, tmp_path, kind, pattern, share):
    dataset = copy(exported[kind], tmp_path)
    path = next(dataset.glob(pattern))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(MalformedFileError):
        faults = audit_dataset(dataset, folders).faults
        # A video that ends early may still be a video.
        if faults and path.suffix == ".mp4":
            raise MalformedFileError(path, faults[0])
    path.unlink()
    with pytest.raises((MissingFileError, MalformedFileError)):
        audit_dataset(dataset, folders)


def test_a_wrong_crc_in_a_shard_is_refused(exported, folders, tmp_path):
    dataset = copy(exported["rlds"], tmp_path)
    path = next(dataset.glob("1.0.0/*train*"))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(MalformedFileError, match="does not match its CRC"):
        audit_dataset(dataset, folders)


def test_other_numbers_pictures_and_episodes_are_found(exported, folders, tmp_path):
    dataset = copy(exported["lerobot-v3"], tmp_path)
    path = dataset / DATA_PATH.format(chunk_index=0, file_index=0)
    table = pq.read_table(path)
    thetas = np.array(table["annotation.object_joint"].to_pylist(), np.float32)
    thetas[20] += 1e-4
    column = table.column_names.index("annotation.object_joint")
    changed = table.set_column(column, "annotation.object_joint", [thetas])
    pq.write_table(changed, path)
    assert any(
        "'annotation.object_joint' of episode 000001" in f for f in audit_dataset(dataset, folders).faults
    )
    pq.write_table(table, path)
    assert audit_dataset(dataset, folders).faults == []
    front, side = (
        dataset / f"videos/observation.images.{name}/chunk-000/file-000.mp4" for name in ("front", "side")
    )
    shutil.copy(side, front)
    found = audit_dataset(dataset, folders)
    assert len(found.faults) == 4
    assert "camera 'front' of episode 000000" in found.faults[0]


def test_episodes_that_are_missing_or_foreign_are_found(exported, folders, tmp_path):
    dataset = exported["hdf5"]
    assert audit_dataset(dataset, folders[:3]).faults == [
        "episode 3 is not committed, is rejected, or occurs twice"
    ]
    more = [*folders, commit(tmp_path, 7, 8)]
    assert audit_dataset(dataset, more).faults == [
        "1 committed episodes are not in the dataset, the first is 7"
    ]


def test_a_folder_that_is_no_dataset_is_refused(folders, tmp_path):
    with pytest.raises(MalformedFileError, match="is not a dataset"):
        audit_dataset(tmp_path, folders)
    with pytest.raises(MissingFileError):
        audit_dataset(tmp_path / "none", folders)


def test_the_dataset_of_somebody_else_is_refused(exported, folders, tmp_path):
    dataset = copy(exported["lerobot-v3"], tmp_path)
    path = dataset / EPISODES_PATH.format(chunk_index=0, file_index=0)
    pq.write_table(pq.read_table(path).drop(["aomgen/source_index"]), path)
    with pytest.raises(MalformedFileError, match="source_index"):
        audit_dataset(dataset, folders)


def test_the_table_of_episodes_is_split_into_files_of_limited_size(folders, tmp_path, monkeypatch):
    monkeypatch.setattr("aomgen.datasets.lerobot_v3.DATA_FILE_MB", 1e-3)
    export_dataset(folders, tmp_path / "dataset", "lerobot-v3", media="none")
    files = sorted((tmp_path / "dataset" / "meta" / "episodes").rglob("*.parquet"))
    assert len(files) == len(folders)
    assert [pq.read_table(path)["meta/episodes/file_index"][0].as_py() for path in files] == list(
        range(len(files))
    )
    assert audit_dataset(tmp_path / "dataset", folders).faults == []
