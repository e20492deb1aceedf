"""Rerun and MCAP recordings, read back by other readers than ours."""

import base64
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from aomgen.core.lens import Lens, undistorter
from aomgen.core.transforms import matrix_from_quat
from aomgen.exports.mcap_recording import write_mcap
from aomgen.exports.scene_motion import SceneMotion
from aomgen.io.video import encode_video, read_frames


def test_rerun(motion: SceneMotion, tmp_path: Path) -> None:
    chunks = pytest.importorskip("rerun.chunk", reason="extra rerun is not installed")
    from aomgen.exports.rerun_recording import write_rerun

    write_rerun(motion, tmp_path / "motion.rrd")
    assert [item.name for item in tmp_path.iterdir()] == ["motion.rrd"]
    columns: dict[str, dict[str, list]] = {}
    for chunk in chunks.RrdReader(tmp_path / "motion.rrd").stream():
        batch = chunk.to_record_batch()
        for name in (name for name in batch.schema.names if name == "time" or ":" in name):
            column = batch.column(name)
            values = column.cast("int64") if name == "time" else column
            columns.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(values.to_pylist())
    twin = motion.twin
    for number in np.unique(twin.bodies):
        entity = columns[f"/world/{twin.body_names[number]}"]
        centers = np.array(entity["GaussianSplats3D:centers"][0])
        np.testing.assert_array_equal(centers, twin.gaussians.means[twin.bodies == number])
    poses = columns["/world/forearm_link"]
    number = twin.body("forearm_link")
    found = np.array(poses["Transform3D:translation"]).reshape(-1, 3)
    np.testing.assert_allclose(found, motion.Ts_world_body[:, number, :3, 3], atol=1e-6)
    quats = np.roll(np.array(poses["Transform3D:quaternion"]).reshape(-1, 4), 1, axis=1)
    np.testing.assert_allclose(matrix_from_quat(quats), motion.Ts_world_body[:, number, :3, :3], atol=1e-5)
    np.testing.assert_allclose(np.array(poses["time"]) / 1e9, motion.trajectory.times_s, atol=1e-9)
    assert np.array(columns["/joints/object"]["Scalars:scalars"]).ravel().tolist() == pytest.approx(motion.trajectory.thetas)  # fmt: skip
    video = columns["/world/camera/front/video"]
    assert bytes(video["AssetVideo:blob"][0][0]) == motion.videos["front"].read_bytes()
    assert len(video["VideoFrameReference:timestamp"]) >= len(motion.trajectory)
    assert len([row for row in columns["/world/contacts/left"]["Arrows3D:vectors"] if row]) == 2


LENS = Lens(fx=50, fy=50, cx=32, cy=24, width=64, height=48, k1=-0.3)


def difference(found: np.ndarray, motion: SceneMotion) -> float:
    """The mean difference of an image to the undistorted first frame of the recording."""
    recorded = read_frames(motion.videos["front"], [0])[0]
    return float(np.abs(found.astype(float) - undistorter(LENS)(recorded)).mean())


@pytest.fixture
def bent(motion: SceneMotion, tmp_path_factory: pytest.TempPathFactory) -> SceneMotion:
    """The motion with a smooth video of a distorted camera."""
    video = tmp_path_factory.mktemp("bent") / "front.mp4"
    image = np.tile((2 * np.mgrid[:48, :64].sum(0))[..., None], 3).astype(np.uint8)
    video.write_bytes(encode_video([image] * len(motion.trajectory), 10))
    return replace(motion, videos={"front": video}, lenses={"front": LENS})


def test_rerun_shows_undistorted_images(bent: SceneMotion, tmp_path: Path) -> None:
    chunks = pytest.importorskip("rerun.chunk", reason="extra rerun is not installed")
    from aomgen.exports.rerun_recording import write_rerun

    write_rerun(bent, tmp_path / "motion.rrd")
    times_ns = []
    for chunk in chunks.RrdReader(tmp_path / "motion.rrd").stream():
        if chunk.entity_path == "/world/camera/front/video":
            batch = chunk.to_record_batch()
            if "AssetVideo:blob" in batch.schema.names:
                blob = batch.column("AssetVideo:blob").to_pylist()[0][0]
                (tmp_path / "front.mp4").write_bytes(bytes(blob))
            else:
                times_ns = batch.column("time").cast("int64").to_pylist()
    assert difference(read_frames(tmp_path / "front.mp4", [0])[0], bent) < 2
    np.testing.assert_allclose(times_ns, 1e9 * bent.trajectory.times_s, atol=1e3)


def test_mcap_shows_undistorted_images(bent: SceneMotion, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader")
    write_mcap(bent, tmp_path / "motion.mcap")
    with (tmp_path / "motion.mcap").open("rb") as file:
        messages = reader.make_reader(file).iter_messages(topics=["/camera/front/image"])
        data = json.loads(next(messages)[2].data)["data"]
    assert difference(np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))), bent) < 2


def test_mcap(motion: SceneMotion, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader")
    write_mcap(motion, tmp_path / "motion.mcap")
    found: dict[str, list] = {}
    with (tmp_path / "motion.mcap").open("rb") as file:
        for schema, channel, message in reader.make_reader(file, validate_crcs=True).iter_messages():
            described = json.loads(schema.data)
            content = json.loads(message.data)
            assert described["title"] == schema.name
            assert set(described["required"]) == set(content)
            found.setdefault(f"{channel.topic} {schema.name}", []).append((message.log_time, content))
    frames = len(motion.trajectory)
    assert {name: len(rows) for name, rows in found.items()} == {
        "/joint_states foxglove.JointStates": frames,
        "/joint_commands foxglove.JointStates": frames,
        "/tf foxglove.FrameTransforms": frames,
        "/camera/front/image foxglove.CompressedImage": frames,
        "/camera/front/calibration foxglove.CameraCalibration": 1,
        "/camera/hand/calibration foxglove.CameraCalibration": 1,
    }
    time_ns, states = found["/joint_states foxglove.JointStates"][20]
    assert time_ns == 2_000_000_000
    assert states["timestamp"] == {"sec": 2, "nsec": 0}
    positions = {item["name"]: item["position"] for item in states["joints"]}
    assert positions["object"] == pytest.approx(motion.trajectory.thetas[20])
    assert positions["elbow_joint"] == pytest.approx(motion.trajectory.joints[20, 2])
    _, poses = found["/tf foxglove.FrameTransforms"][20]
    part = next(item for item in poses["transforms"] if item["child_frame_id"] == "part")
    T = motion.Ts_world_body[20, motion.twin.body("part")]
    assert [part["translation"][axis] for axis in "xyz"] == pytest.approx(T[:3, 3])
    quat = np.array([part["rotation"][axis] for axis in "wxyz"])
    np.testing.assert_allclose(matrix_from_quat(quat), T[:3, :3], atol=1e-9)
    _, image = found["/camera/front/image foxglove.CompressedImage"][0]
    assert Image.open(io.BytesIO(base64.b64decode(image["data"]))).size == (64, 48)
