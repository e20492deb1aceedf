"""Bad recordings, options and targets: one sentence, a typed error, nothing half-written."""

import builtins
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from aomgen.errors import (
    AomgenError,
    BackendError,
    ConfigError,
    IncompleteCaptureError,
    MalformedFileError,
    MissingFileError,
    NonFiniteError,
    StorageError,
    UnitsError,
    UnknownNameError,
    UnsafePathError,
)
from aomgen.importers.import_demo import ImportOptions, import_demo
from aomgen.io.video import encode_video
from command_line import aomgen, one_sentence
from foreign_recordings import (
    JOINTS,
    BagWriter,
    Demonstration,
    read_annex_b,
    write_bag,
    write_lerobot_v3,
    write_lerobot_v21,
    write_table,
)


def refuse(
    source: Path, folder: Path, kind: type[AomgenError], *words: str, episode: int = 0, **options
) -> None:
    """The import ends with an error of a kind, and its folder holds what it held before."""
    before = sorted(folder.rglob("*"))
    with pytest.raises(AomgenError) as caught:
        import_demo(source, folder / "capture", episode, ImportOptions(**options))
    message = str(caught.value)
    assert type(caught.value) is kind, message
    assert "\n" not in message
    assert ".staging" not in message
    for word in words:
        assert word in message, message
    assert sorted(folder.rglob("*")) == before


@pytest.fixture
def target(tmp_path: Path) -> Path:
    """An empty folder that the capture would be made in."""
    folder = tmp_path / "target"
    folder.mkdir()
    return folder


@pytest.fixture
def log(short: Demonstration, tmp_path: Path) -> Path:
    """A sound table of joints."""
    columns = [short.times_s, short.joints, short.gripper]
    return write_table(tmp_path / "log.csv", ["time_s", *JOINTS, "gripper"], columns)


def write_joints(path: Path, short: Demonstration, **topics: tuple[str, ...]) -> Path:
    """A bag of joint states without video: prefixes of the joints' names by topic."""
    with BagWriter(path, "mcap") as bag:
        for k, time_s in enumerate(short.times_s.tolist()):
            for topic, prefixes in topics.items():
                names = [prefix + name for prefix in prefixes for name in (*JOINTS, "gripper")]
                values = [*short.joints[k], short.gripper[k]] * len(prefixes)
                bag.write_joints(f"/{topic}", time_s, names, values)
    return path


def test_a_missing_source(target: Path):
    refuse(target / "nothing", target, MissingFileError, "is missing", "LeRobot dataset, a ROS 1 bag")


@pytest.mark.parametrize(
    ("content", "kind", "words"),
    [
        (b"", MalformedFileError, "is empty"),
        (b"\x00\x01\x02" * 100, MalformedFileError, "is not a text file"),
        (b"#ROSBAG V2.0\n", MalformedFileError, "is not readable as ROS 1 bag"),
        (b"\x89MCAP0\r\n", MalformedFileError, "is not readable as MCAP"),
        (b"SQLite format 3\0", MalformedFileError, "is not readable as ROS 2 database"),
        (b"a,b\n", IncompleteCaptureError, "has no rows"),
        (b"a,b\n1,2\n", MalformedFileError, "no column 'time_s' (columns: a, b)"),
        (b"time_s,a\n1,x\n", MalformedFileError, "no columns of numbers"),
    ],
)
def test_files_that_hold_no_recording(target: Path, tmp_path: Path, content: bytes, kind, words: str):
    path = tmp_path / "recording"
    path.write_bytes(content)
    refuse(path, target, kind, words)


def test_a_folder_that_is_no_recording(target: Path, tmp_path: Path, log: Path):
    refuse(tmp_path, target, MalformedFileError, "is a folder with log.csv, ")


def test_a_bag_without_messages(target: Path, tmp_path: Path):
    for kind in ("ros1", "sqlite", "mcap"):
        with BagWriter(tmp_path / kind, kind):
            pass
        refuse(tmp_path / kind, target, IncompleteCaptureError, "holds no messages")


def test_a_bag_without_joint_states_lists_its_topics(target: Path, tmp_path: Path, short: Demonstration):
    with BagWriter(tmp_path / "bag", "mcap") as bag:
        bag.write_image("/front/image_raw", 0.0, short.frames[0])
    refuse(
        tmp_path / "bag",
        target,
        IncompleteCaptureError,
        "no joint states (topics: /front/image_raw (sensor_msgs",
    )


def test_topics(target: Path, tmp_path: Path, short: Demonstration):
    path = write_joints(tmp_path / "bag", short, left=("",), right=("",))
    camera = {"cameras": (f"front={short.video}",)}
    refuse(path, target, ConfigError, "2 robots: /left, /right; choose one with --topic", **camera)
    refuse(
        path,
        target,
        UnknownNameError,
        "'/center' is unknown; known: /left, /right",
        topic="/center",
        **camera,
    )
    refuse(path, target, IncompleteCaptureError, "holds no video; give a video file: --camera front=FILE")
    refuse(path, target, UnknownNameError, "'/front' is unknown", cameras=("front=/front",))
    refuse(path, target, ConfigError, "'a b' is not a valid name", cameras=("a b=/front",))


def test_two_robots_in_one_topic(target: Path, tmp_path: Path, short: Demonstration):
    path = write_joints(tmp_path / "bag", short, joint_states=("left_", "right_"))
    camera = {"cameras": (f"front={short.video}",)}
    words = "2 columns for 'shoulder_pan_joint': left_shoulder_pan_joint, right_shoulder_pan_joint"
    refuse(path, target, ConfigError, words, "--joint-map 'left_*'", **camera)
    refuse(path, target, ConfigError, "2 columns of a gripper", joint_map=("left_*",), **camera)
    options = ImportOptions(joint_map=("left_*",), gripper_column="left_gripper", **camera)
    assert any("left_elbow_joint" in note for note in import_demo(path, target / "capture", 0, options))


def test_a_gripper_on_another_clock(target: Path, tmp_path: Path, short: Demonstration):
    with BagWriter(tmp_path / "bag", "mcap") as bag:
        for k, time_s in enumerate(short.times_s.tolist()):
            bag.write_joints("/joint_states", time_s, JOINTS, short.joints[k])
            bag.write_joints("/hand", time_s + 5.0, ["gripper"], [short.gripper[k]])
    words = "/hand has values from 1750000005.25 s to 1750000007.55 s, /joint_states from 1750000000.25 s"
    refuse(tmp_path / "bag", target, IncompleteCaptureError, words, cameras=(f"front={short.video}",))


def test_missing_joints_suggest_near_names(target: Path, tmp_path: Path, short: Demonstration):
    names = [name.replace("wrist", "rist") for name in JOINTS]
    path = write_table(
        tmp_path / "log.csv", ["t", *names, "gripper"], [short.times_s, short.joints, short.gripper]
    )
    words = (
        "no column for joint 'wrist_1_joint' and 2 more",
        "did you mean 'rist_1_joint'? State it with --joint-map",
    )
    refuse(path, target, MalformedFileError, *words, cameras=(f"front={short.video}",))


@pytest.mark.parametrize("message_type", ["sensor_msgs/msg/Image", "foxglove_msgs/msg/CompressedVideo"])
def test_topics_without_frames(target: Path, tmp_path: Path, short: Demonstration, message_type: str):
    with BagWriter(tmp_path / "bag", "sqlite") as bag:
        bag.bag.add_connection("/front", message_type, typestore=bag.types)
        for k, time_s in enumerate(short.times_s.tolist()):
            bag.write_joints("/joints", time_s, [*JOINTS, "gripper"], [*short.joints[k], short.gripper[k]])
    refuse(tmp_path / "bag", target, IncompleteCaptureError, "/front: has no frames")


def test_topics_that_cannot_be_decoded(target: Path, tmp_path: Path, short: Demonstration):
    with BagWriter(tmp_path / "bag", "sqlite") as bag:
        for k, time_s in enumerate(short.times_s.tolist()):
            bag.write_joints("/joints", time_s, [*JOINTS, "gripper"], [*short.joints[k], short.gripper[k]])
            bag.write_h264("/side", time_s, read_annex_b(short.video)[1])
            bag.write_h264("/top", time_s, b"x", form="h265")
            bag.write_image("/bayer", time_s, short.frames[k], "bayer_rggb8")
    refuse(tmp_path / "bag", target, IncompleteCaptureError, "24 packets and no key frame", cameras=("side",))
    refuse(tmp_path / "bag", target, MalformedFileError, "format 'h265'; record it as h264", cameras=("top",))
    refuse(
        tmp_path / "bag",
        target,
        MalformedFileError,
        "encoding 'bayer_rggb8' (known: rgb8,",
        cameras=("bayer",),
    )


def test_cameras_that_move_or_share_a_name(target: Path, tmp_path: Path, short: Demonstration):
    with BagWriter(tmp_path / "bag", "mcap") as bag:
        bag.write_joints("/joint_states", 0.0, [*JOINTS, "gripper"], [*short.joints[0], 0.0])
        bag.write_image("/wrist/image_raw", 0.0, short.frames[0])
    refuse(
        tmp_path / "bag", target, ConfigError, "cameras on the arm: /wrist/image_raw; select a fixed camera"
    )
    with BagWriter(tmp_path / "both", "mcap") as bag:
        bag.write_joints("/joint_states", 0.0, [*JOINTS, "gripper"], [*short.joints[0], 0.0])
        bag.write_image("/front/image_raw", 0.0, short.frames[0])
        bag.write_jpeg("/front/image_raw/compressed", 0.0, short.frames[0])
    refuse(tmp_path / "both", target, ConfigError, "several videos of one camera", "--camera NAME=SOURCE")
    twice = ("a=/front/image_raw", "a=/front/image_raw/compressed")
    refuse(tmp_path / "both", target, ConfigError, "gives two cameras the same name (a, a)", cameras=twice)


def test_video_files_without_frames(target: Path, tmp_path: Path, log: Path):
    broken, empty = tmp_path / "broken.mp4", tmp_path / "empty.mp4"
    broken.write_bytes(b"no video")
    empty.write_bytes(encode_video([np.zeros((32, 32, 3), np.uint8)], 10)[:300])
    refuse(log, target, IncompleteCaptureError, "holds no video; give a video file: --camera front=FILE")
    refuse(log, target, MalformedFileError, "broken.mp4: is not a video", cameras=(f"front={broken}",))
    refuse(log, target, MalformedFileError, "empty.mp4: is not a video", cameras=(f"front={empty}",))
    data = encode_video([np.zeros((32, 32, 3), np.uint8)] * 3, 10)
    broken.write_bytes(data.replace(b"avc1", b"zzz1").replace(b"isomiso2zzz1", b"isomiso2avc1"))
    refuse(log, target, MalformedFileError, "a codec that FFmpeg does not know", cameras=(f"front={broken}",))


def test_episodes(target: Path, tmp_path: Path, short: Demonstration, log: Path):
    for number, write in enumerate((write_lerobot_v3, write_lerobot_v21)):
        source = write(tmp_path / f"dataset{number}", short)
        refuse(source, target, ConfigError, "--episode: is 2", "has 2 episodes; expected 0 .. 1", episode=2)
    refuse(log, target, ConfigError, "--episode: is 1", "has 1 episode; expected 0", episode=1)


def edit_info(change: Callable[[dict], object]) -> Callable[[Path], object]:
    def damage(dataset: Path) -> None:
        path = dataset / "meta/info.json"
        info = json.loads(path.read_text())
        change(info)
        path.write_text(json.dumps(info))

    return damage


def drop_column(dataset: Path) -> None:
    path = dataset / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["timestamp"]), path)


def cut_episode(dataset: Path) -> None:
    path = dataset / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.filter(pa.compute.equal(table["episode_index"], 1)), path)


@pytest.mark.parametrize(
    ("damage", "kind", "words"),
    [
        (
            edit_info(lambda info: info.update(codebase_version="v1.6")),
            MalformedFileError,
            "'v1.6', known are v2.1",
        ),
        (edit_info(lambda info: info.pop("features")), MalformedFileError, "not a complete LeRobot dataset"),
        (
            edit_info(lambda info: info.update(video_path="../../{video_key}")),
            UnsafePathError,
            "outside its folder",
        ),
        (edit_info(lambda info: info.update(data_path="{length:099d}")), MissingFileError, "is missing"),
        (
            edit_info(lambda info: info["features"].pop("observation.images.front")),
            IncompleteCaptureError,
            "no video",
        ),
        (lambda dataset: shutil.rmtree(dataset / "videos"), MissingFileError, "info.json refers to it"),
        (lambda dataset: shutil.rmtree(dataset / "meta/episodes"), MalformedFileError, "lacks episode 0"),
        (drop_column, MalformedFileError, "not a complete LeRobot dataset"),
        (cut_episode, IncompleteCaptureError, "no rows of episode 0"),
    ],
)
def test_damaged_datasets(target: Path, tmp_path: Path, short: Demonstration, damage, kind, words: str):
    source = write_lerobot_v3(tmp_path / "dataset", short)
    damage(source)
    refuse(source, target, kind, words)


def test_units_and_numbers(target: Path, tmp_path: Path, short: Demonstration):
    camera = {"cameras": (f"front={short.video}",)}
    header = ["time_s", *JOINTS, "gripper"]

    def write(**changes: np.ndarray) -> Path:
        changed = replace(short, **changes)
        return write_table(tmp_path / "log.csv", header, [changed.times_s, changed.joints, changed.gripper])

    degrees = write(joints=np.degrees(short.joints) * 0.6)
    refuse(degrees, target, UnitsError, "degrees, or normalized", "--unit deg or --unit normalized", **camera)
    refuse(write(gripper=0.085 * (1 - short.gripper)), target, UnitsError, "--gripper-open 0.085", **camera)
    refuse(write(gripper=1 - short.gripper), target, UnitsError, "reversed?", **camera)
    refuse(
        write(joints=np.where(short.joints > 2, np.nan, short.joints)),
        target,
        NonFiniteError,
        "row 0 of",
        **camera,
    )
    refuse(
        write(times_s=1000 * short.times_s),
        target,
        UnitsError,
        "milliseconds?; divide time_s by 1000",
        **camera,
    )
    refuse(
        write(times_s=short.times_s * 5),
        target,
        IncompleteCaptureError,
        "0.50 s apart, limit 0.25 s",
        **camera,
    )
    refuse(
        write(joints=short.joints * 0), target, IncompleteCaptureError, "has no joint that moves", **camera
    )
    few = write_table(tmp_path / "few.csv", header, [short.times_s[:5], short.joints[:5], short.gripper[:5]])
    refuse(few, target, IncompleteCaptureError, "few.csv: has 5 rows, at least 10 are needed", **camera)
    refuse(
        write(),
        target,
        ConfigError,
        "--unit: is 'grad'; expected rad, deg, normalized",
        unit="grad",
        **camera,
    )
    refuse(write(), target, ConfigError, "'ur99' is unknown; known: ur5e_2f85", robot="ur99", **camera)


def test_targets(target: Path, log: Path, short: Demonstration, capture_copy: Path, sample: Path):
    options = ImportOptions(cameras=(f"front={short.video}",))
    with pytest.raises(ConfigError, match="exists already; replace it with --replace"):
        import_demo(log, capture_copy, 0, options)
    with pytest.raises(ConfigError, match="names its robot; leave it out"):
        import_demo(log, capture_copy, 0, replace(options, replace=True, robot="ur5e_2f85"))
    (capture_copy / "capture.toml").write_text("[robot]\njoint = 3")
    with pytest.raises(MalformedFileError, match=r"'robot.joint' is unknown; did you mean 'joints'"):
        import_demo(log, capture_copy, 0, replace(options, replace=True))
    assert (capture_copy / "demo/front.mp4").read_bytes() == (sample / "demo/front.mp4").read_bytes()
    with pytest.raises(ConfigError, match="is a file"):
        import_demo(log, log, 0, options)
    with pytest.raises(StorageError, match="cannot be written"):
        import_demo(log, Path("/proc/capture"), 0, options)


def test_a_capture_whose_tables_cannot_be_replaced_stays(capture_copy: Path, log: Path, short: Demonstration):
    path = capture_copy / "capture.toml"
    path.write_text("demo = {joints = 'x'}\n" + path.read_text().replace("[demo]\njoints = \"demo/joints.csv\"\n", "")
                    .replace("[[demo.cameras]]", "[[cameras]]"))  # fmt: skip
    before = {item: item.stat().st_mtime_ns for item in capture_copy.rglob("*")}
    with pytest.raises(MalformedFileError, match="cannot be replaced"):
        import_demo(log, capture_copy, 0, ImportOptions(cameras=(f"front={short.video}",), replace=True))
    assert {item: item.stat().st_mtime_ns for item in capture_copy.rglob("*")}.keys() == before.keys()
    assert (capture_copy / "demo/joints.csv").stat().st_mtime_ns == before[capture_copy / "demo/joints.csv"]


def test_without_rosbags(target: Path, tmp_path: Path, short: Demonstration, monkeypatch: pytest.MonkeyPatch):
    path = write_bag(tmp_path / "bag", short.first(12), "mcap", "h264")
    imports = builtins.__import__

    def refuse_rosbags(name: str, *arguments, **more):
        if name.startswith("rosbags"):
            raise ImportError(name)
        return imports(name, *arguments, **more)

    monkeypatch.setattr(builtins, "__import__", refuse_rosbags)
    refuse(path, target, BackendError, "rosbags: is not installed; pip install 'aomgen[ros]'")


def test_the_command_line(tmp_path: Path, short: Demonstration, log: Path):
    result = aomgen("import", "demo", log, "capture", "--camera", f"front={short.video}", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "'gripper' is read as 0 (open) .. 1 (closed)" in result.stdout
    assert "next: complete capture/capture.toml, then aomgen check capture" in result.stdout
    one_sentence(aomgen("import", "demo", log, "other", folder=tmp_path), 3, "--camera front=FILE")
    one_sentence(
        aomgen("import", "demo", log, "other", "--episode", "4", folder=tmp_path), 2, "has 1 episode"
    )
    assert not (tmp_path / "other").exists()
