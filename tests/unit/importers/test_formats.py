"""One demonstration in every format comes in as it was recorded."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from aomgen.capture.joint_log import read_joint_log
from aomgen.capture.read import read_capture
from aomgen.core.recording import JointLog
from aomgen.importers.import_demo import ImportOptions, import_demo
from aomgen.io.images import encode_png
from aomgen.io.video import encode_video, read_video
from foreign_recordings import (
    EPOCH_S,
    JOINTS,
    RTDE_START_S,
    BagWriter,
    Demonstration,
    read_annex_b,
    write_bag,
    write_lerobot_v3,
    write_lerobot_v21,
    write_rtde,
    write_table,
)

IDENTICAL_DB, ENCODED_DB = 100.0, 40.0


def read_log(capture: Path) -> JointLog:
    return read_joint_log(capture / "demo" / "joints.csv", JOINTS, "gripper")[0]


def compare(capture: Path, native: Demonstration, least_db: float) -> None:
    """Joints within 1e-6 rad, gripper within 1e-3, times within 1 ms, images of at least some PSNR."""
    log, video = read_log(capture), read_video(capture / "demo" / "front.mp4")
    np.testing.assert_allclose(log.joints, native.joints, atol=1e-6, rtol=0)
    np.testing.assert_allclose(log.gripper, native.gripper, atol=1e-3, rtol=0)
    np.testing.assert_allclose(log.times_s - log.times_s[0], native.times_s, atol=1e-3, rtol=0)
    np.testing.assert_allclose(video.times_s, native.times_s, atol=1e-3, rtol=0)
    errors = video.frames_srgb.astype(np.float32) - native.frames
    psnr_db = 10 * np.log10(255**2 / max(float((errors**2).mean((1, 2, 3)).max()), 1e-9))
    assert psnr_db >= least_db


def test_the_bundled_capture_as_lerobot_v3(whole: Demonstration, capture_copy: Path, tmp_path: Path):
    source = write_lerobot_v3(tmp_path / "dataset", whole)
    import_demo(source, capture_copy, 1, ImportOptions(replace=True))
    compare(capture_copy, whole, IDENTICAL_DB)
    recorded = read_capture(capture_copy)
    assert recorded.instruction == "open the microwave"
    assert len(recorded.prompts) == 6
    assert recorded.cameras[0].intrinsics is not None


@pytest.mark.parametrize("write", [write_lerobot_v3, write_lerobot_v21])
@pytest.mark.parametrize("episode", [0, 1])
def test_lerobot(short: Demonstration, tmp_path: Path, write, episode: int):
    names: Any = [f"{name.removesuffix('_joint')}.pos" for name in JOINTS] + ["gripper.pos"]
    names = {"motors": names} if episode else [names]
    notes = import_demo(write(tmp_path / "dataset", short, names), tmp_path / "capture", episode)
    compare(tmp_path / "capture", short, IDENTICAL_DB)
    text = (tmp_path / "capture" / "capture.toml").read_text()
    assert 'instruction = "open the microwave"' in text
    assert "# clock_offset_s = 0.000000" in text
    assert any("shoulder_pan_joint = shoulder_pan.pos" in note for note in notes)


def test_lerobot_with_images_in_its_table(short: Demonstration, tmp_path: Path):
    source = write_lerobot_v21(tmp_path / "dataset", short)
    info = source / "meta/info.json"
    info.write_text(info.read_text().replace('"dtype": "video"', '"dtype": "image"'))
    path = source / "data/chunk-000/episode_000000.parquet"
    images = [{"bytes": encode_png(frame), "path": None} for frame in short.frames]
    pq.write_table(pq.read_table(path).append_column("observation.images.front", pa.array(images)), path)
    import_demo(source, tmp_path / "capture")
    compare(tmp_path / "capture", short, ENCODED_DB)


def test_av1_is_copied(short: Demonstration, tmp_path: Path):
    path = tmp_path / "av1.mp4"
    path.write_bytes(encode_video(short.frames, 10, codec="av1"))
    coded = replace(short, video=path, frames=read_video(path).frames_srgb)
    import_demo(write_lerobot_v3(tmp_path / "dataset", coded), tmp_path / "capture", 1)
    compare(tmp_path / "capture", coded, IDENTICAL_DB)
    assert probe_codec(tmp_path / "capture/demo/front.mp4") == "av1"


def probe_codec(path: Path) -> str:
    with av.open(str(path)) as container:
        return container.streams.video[0].codec_context.codec.canonical_name


def test_an_episode_that_begins_between_key_frames_is_encoded_again(short: Demonstration, tmp_path: Path):
    source = write_lerobot_v3(tmp_path / "dataset", short)
    # Every second frame is a key frame; after an odd number of frames the second episode starts on another one.
    video = source / "videos/observation.images.front/chunk-000/file-000.mp4"
    video.write_bytes(encode_video([short.frames[0], *short.frames, *short.frames], 10, crf=8))
    frames = read_video(video).frames_srgb[1:25]
    path = source / "meta/episodes/chunk-000/file-000.parquet"
    rows = pq.read_table(path).to_pylist()
    rows[1]["videos/observation.images.front/from_timestamp"] = 0.1
    rows[1]["videos/observation.images.front/to_timestamp"] = 2.5
    pq.write_table(pa.Table.from_pylist(rows), path)
    notes = import_demo(source, tmp_path / "capture", 1)
    compare(tmp_path / "capture", replace(short, frames=frames), ENCODED_DB)
    assert any("encoded as H.264" in note for note in notes)


@pytest.mark.parametrize(
    ("kind", "video", "least_db"),
    [
        ("ros1", "jpeg", ENCODED_DB),
        ("ros1", "h264", IDENTICAL_DB),
        ("sqlite", "image", ENCODED_DB),
        ("mcap", "h264", IDENTICAL_DB),
    ],
)
def test_bags(short: Demonstration, tmp_path: Path, kind: str, video: str, least_db: float):
    path = write_bag(tmp_path / "recording.bag", short, kind, video)
    import_demo(path, tmp_path / "capture")
    compare(tmp_path / "capture", short, least_db)
    assert read_log(tmp_path / "capture").times_s[0] == pytest.approx(EPOCH_S, abs=1e-6)
    assert f"# clock_offset_s = {EPOCH_S:.6f}" in (tmp_path / "capture" / "capture.toml").read_text()


@pytest.mark.parametrize(("kind", "pattern"), [("sqlite", "*.db3"), ("mcap", "*.mcap")])
def test_files_of_a_bag_alone_under_another_name(
    short: Demonstration, tmp_path: Path, kind: str, pattern: str
):
    (file,) = write_bag(tmp_path / "bag", short, kind, "h264").glob(pattern)
    import_demo(file.rename(tmp_path / "recording.dat"), tmp_path / "capture")
    compare(tmp_path / "capture", short, IDENTICAL_DB)


def test_depth_and_cameras_on_the_arm_are_left_out(short: Demonstration, tmp_path: Path):
    packets = read_annex_b(short.video)
    with BagWriter(tmp_path / "bag", "sqlite") as bag:
        for k, time_s in enumerate(short.times_s.tolist()):
            bag.write_joints(
                "/joint_states", time_s, [*JOINTS, "gripper"], [*short.joints[k], short.gripper[k]]
            )
            bag.write_h264("/front/video", time_s, packets[k])
            bag.write_h264("/wrist/video", time_s, packets[k])
            bag.write_image("/depth/image_raw", time_s, short.frames[k], "16UC1")
    notes = import_demo(tmp_path / "bag", tmp_path / "capture")
    assert [path.name for path in sorted((tmp_path / "capture/demo").iterdir())] == [
        "front.mp4",
        "joints.csv",
    ]
    assert "/depth/image_raw is taken as depth and left out" in notes
    assert "/wrist/video is left out, because its name is that of a camera on the arm" in notes


def test_h264_that_begins_between_key_frames(short: Demonstration, tmp_path: Path):
    packets = read_annex_b(short.video)
    with BagWriter(tmp_path / "bag", "mcap") as bag:
        for k, time_s in enumerate(short.times_s.tolist()):
            bag.write_joints(
                "/joint_states", time_s, [*JOINTS, "gripper"], [*short.joints[k], short.gripper[k]]
            )
            if k:
                bag.write_h264("/front", time_s, packets[k])
    notes = import_demo(tmp_path / "bag", tmp_path / "capture")
    video = read_video(tmp_path / "capture/demo/front.mp4")
    assert len(video.times_s) == len(short.times_s) - 2
    np.testing.assert_array_equal(video.frames_srgb, short.frames[2:])
    assert any("1 packets" in note and "before the first key frame" in note for note in notes)
    assert f"# clock_offset_s = {EPOCH_S + 0.2:.6f}" in (tmp_path / "capture/capture.toml").read_text()


def test_frames_keep_a_variable_rate(short: Demonstration, tmp_path: Path):
    times_s = short.times_s + np.random.default_rng(0).uniform(0, 0.05, len(short.times_s))
    times_s -= times_s[0]
    with BagWriter(tmp_path / "bag", "sqlite") as bag:
        for k, time_s in enumerate(times_s.tolist()):
            bag.write_joints(
                "/joint_states", time_s, [*JOINTS, "gripper"], [*short.joints[k], short.gripper[k]]
            )
            bag.write_image("/front/image_raw", time_s, short.frames[k, :, :, ::-1], "bgr8")
    import_demo(tmp_path / "bag", tmp_path / "capture")
    compare(tmp_path / "capture", replace(short, times_s=times_s), ENCODED_DB)


def test_arm_and_gripper_on_topics_and_messages_of_their_own(short: Demonstration, tmp_path: Path):
    packets = read_annex_b(short.video)
    with BagWriter(tmp_path / "bag", "mcap") as bag:
        for k, time_s in enumerate(short.times_s.tolist()):
            bag.write_joints("/joint_states", time_s, JOINTS, short.joints[k])
            bag.write_joints("/joint_states", time_s + 0.02, ["left_wheel_joint"], [1.0])
            bag.write_joints("/gripper/joint_states", time_s, ["gripper"], [short.gripper[k]])
            bag.write_h264("/front", time_s, packets[k])
    notes = import_demo(tmp_path / "bag", tmp_path / "capture")
    compare(tmp_path / "capture", short, IDENTICAL_DB)
    assert any("from /gripper/joint_states" in note for note in notes)


def test_a_gripper_without_stamps_beside_an_arm_in_simulated_time(short: Demonstration, tmp_path: Path):
    start_s = 12.0 - EPOCH_S
    packets = read_annex_b(short.video)
    with BagWriter(tmp_path / "bag", "mcap") as bag:
        for k, time_s in enumerate(short.times_s.tolist()):
            message = bag.make(
                "sensor_msgs/msg/JointState",
                header=bag.header(start_s + time_s),
                name=[*JOINTS],
                position=short.joints[k],
                velocity=np.zeros(0),
                effort=np.zeros(0),
            )
            bag.write("/joint_states", time_s, message)
            bag.write("/gripper", time_s, bag.make("std_msgs/msg/Float64", data=float(short.gripper[k])))
            bag.write_h264("/front", time_s, packets[k])
    import_demo(tmp_path / "bag", tmp_path / "capture")
    compare(tmp_path / "capture", short, IDENTICAL_DB)
    assert read_log(tmp_path / "capture").times_s[0] == pytest.approx(12.0)


def test_messages_without_stamps_take_the_times_of_recording(short: Demonstration, tmp_path: Path):
    packets = read_annex_b(short.video)
    with BagWriter(tmp_path / "bag", "mcap") as bag:
        for k, time_s in enumerate(short.times_s.tolist()):
            message = bag.make(
                "sensor_msgs/msg/JointState",
                header=bag.header(-EPOCH_S),
                name=[*JOINTS, "gripper"],
                position=np.append(short.joints[k], short.gripper[k]),
                velocity=np.zeros(0),
                effort=np.zeros(0),
            )
            bag.write("/joint_states", time_s, message)
            bag.write_h264("/front", time_s, packets[k])
    notes = import_demo(tmp_path / "bag", tmp_path / "capture")
    compare(tmp_path / "capture", short, IDENTICAL_DB)
    assert any("has no time stamps" in note for note in notes)


def test_rtde_with_a_video_file(short: Demonstration, tmp_path: Path):
    options = ImportOptions(gripper_column="output_int_register_24", cameras=(f"front={short.video}",))
    import_demo(write_rtde(tmp_path / "record.csv", short), tmp_path / "capture", 0, options)
    compare(tmp_path / "capture", short, IDENTICAL_DB)
    assert (tmp_path / "capture/demo/front.mp4").read_bytes() == short.video.read_bytes()
    assert read_log(tmp_path / "capture").times_s[0] == RTDE_START_S


def test_tags_of_a_video_in_another_encoding(short: Demonstration, tmp_path: Path):
    path = tmp_path / "front.mp4"
    path.write_bytes(short.video.read_bytes().replace(b"mp41", b"\xedp41", 1))
    assert path.read_bytes() != short.video.read_bytes()
    options = ImportOptions(gripper_column="output_int_register_24", cameras=(f"front={path}",))
    import_demo(write_rtde(tmp_path / "record.csv", short), tmp_path / "capture", 0, options)
    compare(tmp_path / "capture", short, IDENTICAL_DB)


def test_rtde_separated_by_spaces_as_the_vendors_client_writes_it(short: Demonstration, tmp_path: Path):
    path = write_rtde(tmp_path / "record.csv", short)
    path.write_text(path.read_text().replace(",", " "))
    options = ImportOptions(gripper_column="output_int_register_24", cameras=(f"front={short.video}",))
    import_demo(path, tmp_path / "capture", 0, options)
    np.testing.assert_allclose(read_log(tmp_path / "capture").joints, short.joints, atol=1e-6)


def test_a_table_in_degrees_milliseconds_and_reversed_counts(short: Demonstration, tmp_path: Path):
    header = ["t_ms", *(f"{name} [deg]" for name in JOINTS), "gripper_position"]
    columns = [1000 * short.times_s, np.degrees(short.joints), 255 * (1 - short.gripper)]
    path = write_table(tmp_path / "log.txt", header, columns)
    options = ImportOptions(gripper_open=255, cameras=(f"front={short.video}",))
    import_demo(path, tmp_path / "capture", 0, options)
    compare(tmp_path / "capture", short, IDENTICAL_DB)


def test_a_table_with_seconds_and_nanoseconds(short: Demonstration, tmp_path: Path):
    header = ["stamp.secs", "stamp.nsecs", *JOINTS, "gripper"]
    seconds, share = np.divmod(short.times_s, 1)
    path = write_table(tmp_path / "log.csv", header, [seconds, 1e9 * share, short.joints, short.gripper])
    options = ImportOptions(cameras=(f"front={short.video}",))
    notes = import_demo(path, tmp_path / "capture", 0, options)
    assert any("'stamp.secs' with 'stamp.nsecs'" in note for note in notes)
    compare(tmp_path / "capture", short, IDENTICAL_DB)


def test_normalized_joints_of_a_lerobot_arm(short: Demonstration, tmp_path: Path):
    high = np.array([6.28319, 6.28319, 3.1415, 6.28319, 6.28319, 6.28319])  # of the UR5e's model, [rad]
    low = -high
    state = np.column_stack([200 * (short.joints - low) / (high - low) - 100, 100 * (1 - short.gripper)])
    source = write_lerobot_v3(tmp_path / "dataset", short, state=state)
    import_demo(source, tmp_path / "capture", 1, ImportOptions(unit="normalized", gripper_open=100))
    compare(tmp_path / "capture", short, IDENTICAL_DB)
