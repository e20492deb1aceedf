"""A demonstration as recorded by other programs: LeRobot datasets, ROS bags, MCAP, RTDE and other tables."""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from av.bitstream import BitStreamFilterContext
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from aomgen.io.images import encode_jpeg
from aomgen.io.video import concatenate_videos

JOINTS = (
    "shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint",
)  # fmt: skip
EPOCH_S = 1_750_000_000.25
RTDE_START_S = 51_234.5
H264 = "foxglove_msgs/msg/CompressedVideo"
H264_DEFINITION = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"


@dataclass(frozen=True)
class Demonstration:
    """Content that every writer stores: the state at the rate of the video, and the video.

    Attributes:
        times_s: (T,), from 0.
        joints: (T, 6), [rad].
        gripper: (T,), 0 open .. 1 closed.
        frames: (T, H, W, 3).
        video: MP4 file of the frames.
    """

    times_s: np.ndarray
    joints: np.ndarray
    gripper: np.ndarray
    frames: np.ndarray
    video: Path

    def first(self, count: int) -> "Demonstration":
        """Select the first frames and rows."""
        cut = slice(0, count)
        return Demonstration(
            self.times_s[cut], self.joints[cut], self.gripper[cut], self.frames[cut], self.video
        )


def write_lerobot_v3(
    folder: Path, demonstration: Demonstration, names: Any = None, state: np.ndarray | None = None
) -> Path:
    """Write two equal episodes in one table and one video, in the layout of LeRobot v3.0."""
    names, state = _state(demonstration, names, state)
    count, fps, key = len(demonstration.times_s), 10, "observation.images.front"
    rows = [
        {
            "episode_index": number, "tasks": ["open the microwave"], "length": count,
            "dataset_from_index": number * count, "dataset_to_index": (number + 1) * count,
            "data/chunk_index": 0, "data/file_index": 0,
            f"videos/{key}/chunk_index": 0, f"videos/{key}/file_index": 0,
            f"videos/{key}/from_timestamp": number * count / fps,
            f"videos/{key}/to_timestamp": (number + 1) * count / fps,
            "stats/observation.state/min": state.min(0).tolist(),
        }
        for number in range(2)
    ]  # fmt: skip
    _write_parquet(folder / "meta/episodes/chunk-000/file-000.parquet", pa.Table.from_pylist(rows))
    tables = [_episode_table(demonstration, state, number) for number in range(2)]
    _write_parquet(folder / "data/chunk-000/file-000.parquet", pa.concat_tables(tables))
    video = folder / f"videos/{key}/chunk-000/file-000.mp4"
    video.parent.mkdir(parents=True)
    video.write_bytes(concatenate_videos([demonstration.video] * 2, fps)[0])
    paths = {
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    _write_info(folder, "v3.0", names, demonstration, paths)
    return folder


def write_lerobot_v21(
    folder: Path, demonstration: Demonstration, names: Any = None, state: np.ndarray | None = None
) -> Path:
    """Write two equal episodes with separate files, in the layout of LeRobot v2.1."""
    names, state = _state(demonstration, names, state)
    rows = [
        {"episode_index": number, "tasks": ["open the microwave"], "length": len(state)}
        for number in range(2)
    ]
    (folder / "meta").mkdir(parents=True)
    (folder / "meta/episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    for number in range(2):
        table = _episode_table(demonstration, state, number)
        _write_parquet(folder / f"data/chunk-000/episode_{number:06d}.parquet", table)
        video = folder / f"videos/chunk-000/observation.images.front/episode_{number:06d}.mp4"
        video.parent.mkdir(parents=True, exist_ok=True)
        video.write_bytes(demonstration.video.read_bytes())
    paths = {
        "chunks_size": 1000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    }
    _write_info(folder, "v2.1", names, demonstration, paths)
    return folder


def _state(demonstration: Demonstration, names: Any, state: np.ndarray | None) -> tuple[Any, np.ndarray]:
    if state is None:
        state = np.column_stack([demonstration.joints, demonstration.gripper])
    return ([*JOINTS, "gripper"] if names is None else names), state


def _episode_table(demonstration: Demonstration, state: np.ndarray, number: int) -> pa.Table:
    count = len(state)
    values = pa.array(state.astype(np.float32).ravel())
    fixed = pa.FixedSizeListArray.from_arrays(values, state.shape[1])
    return pa.table(
        {
            "observation.state": fixed,
            "action": fixed,
            "timestamp": demonstration.times_s.astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, number),
            "index": np.arange(count) + number * count,
            "task_index": np.zeros(count, np.int64),
        }
    )


def _write_info(
    folder: Path, version: str, names: Any, demonstration: Demonstration, paths: Mapping[str, Any]
) -> None:
    height, width = demonstration.frames.shape[1:3]
    state = {"dtype": "float32", "shape": [7], "names": names}
    video = {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"]}
    features = {"observation.state": state, "action": state, "observation.images.front": video}
    features |= {"timestamp": {"dtype": "float32", "shape": [1], "names": None}}
    info = {"codebase_version": version, "fps": 10, "total_episodes": 2, "features": features, **paths}
    (folder / "meta/info.json").write_text(json.dumps(info))


def _write_parquet(path: Path, table: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


class BagWriter:
    """Writer of messages to a ROS 1 bag, a ROS 2 bag of SQLite, or a ROS 2 bag of MCAP."""

    def __init__(self, path: Path, kind: str) -> None:
        self.path, self.ros1 = path, kind == "ros1"
        self.types = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_JAZZY)
        self.types.register(get_types_from_msg(H264_DEFINITION, H264))
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.bag: Any = Writer1(path) if self.ros1 else Writer2(path, version=9, storage_plugin=plugin)
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> "BagWriter":
        self.bag.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.bag.close()

    def make(self, kind: str, **fields: Any) -> Any:
        return self.types.types[kind](**fields)

    def header(self, time_s: float) -> Any:
        """Create a header whose stamp is on the clock of the computer."""
        more = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=self.stamp(time_s), frame_id="", **more)

    def stamp(self, time_s: float) -> Any:
        sec, nanosec = divmod(round((EPOCH_S + time_s) * 1e9), 10**9)
        return self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)

    def write(self, topic: str, time_s: float, message: Any) -> None:
        """Write a message that is recorded 3 ms after its stamp."""
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.bag.add_connection(topic, kind, typestore=self.types)
        serialize = self.types.serialize_ros1 if self.ros1 else self.types.serialize_cdr
        self.bag.write(
            self.connections[topic], round((EPOCH_S + time_s + 0.003) * 1e9), serialize(message, kind)
        )

    def write_joints(self, topic: str, time_s: float, names: Sequence[str], values: Sequence[float]) -> None:
        empty = np.zeros(0)
        self.write(
            topic,
            time_s,
            self.make(
                "sensor_msgs/msg/JointState",
                header=self.header(time_s),
                name=list(names),
                position=np.array(values, np.float64),
                velocity=empty,
                effort=empty,
            ),
        )

    def write_image(self, topic: str, time_s: float, image: np.ndarray, encoding: str = "rgb8") -> None:
        height, width = image.shape[:2]
        self.write(
            topic,
            time_s,
            self.make(
                "sensor_msgs/msg/Image",
                header=self.header(time_s),
                height=height,
                width=width,
                encoding=encoding,
                is_bigendian=0,
                step=image[0].size,
                data=image.reshape(-1),
            ),
        )

    def write_jpeg(self, topic: str, time_s: float, image: np.ndarray) -> None:
        data = np.frombuffer(encode_jpeg(image, 97, halve_colors=False), np.uint8)
        kind = "sensor_msgs/msg/CompressedImage"
        self.write(topic, time_s, self.make(kind, header=self.header(time_s), format="jpeg", data=data))

    def write_h264(self, topic: str, time_s: float, data: bytes, form: str = "h264") -> None:
        array = np.frombuffer(data, np.uint8)
        self.write(
            topic, time_s, self.make(H264, timestamp=self.stamp(time_s), frame_id="", data=array, format=form)
        )


def write_bag(path: Path, demonstration: Demonstration, kind: str, video: str) -> Path:
    """Write a bag with joint states in another order and a video: "image", "jpeg" or "h264"."""
    names = [*reversed(JOINTS), "gripper"]
    packets = read_annex_b(demonstration.video) if video == "h264" else []
    with BagWriter(path, kind) as bag:
        for k, time_s in enumerate(demonstration.times_s.tolist()):
            values = [*demonstration.joints[k, ::-1], demonstration.gripper[k]]
            bag.write_joints("/joint_states", time_s, names, values)
            if video == "image":
                bag.write_image("/front/image_raw", time_s, demonstration.frames[k])
            elif video == "jpeg":
                bag.write_jpeg("/front/image_raw/compressed", time_s, demonstration.frames[k])
            elif video == "h264":
                bag.write_h264("/front/video", time_s, packets[k])
    return path


def read_annex_b(video: Path) -> list[bytes]:
    """Read the packets of an H.264 file as cameras send them, with their parameters before each key frame."""
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        convert = BitStreamFilterContext("h264_mp4toannexb", stream)
        packets = [out for packet in container.demux(stream) for out in convert.filter(packet)]
        return [bytes(packet) for packet in packets if packet.size]


def write_table(path: Path, header: Sequence[str], columns: Sequence[np.ndarray]) -> Path:
    """Write columns to a CSV file."""
    text = io.StringIO()
    text.write(",".join(header) + "\n")
    for row in np.column_stack(columns):
        text.write(",".join(f"{value:.9f}" for value in row) + "\n")
    path.write_text(text.getvalue())
    return path


def write_rtde(path: Path, demonstration: Demonstration) -> Path:
    """Write a recording of RTDE with the gripper in a register, 0 .. 255."""
    header = [
        "timestamp",
        *(f"actual_q_{k}" for k in range(6)),
        "actual_TCP_force_0",
        "output_int_register_24",
    ]
    columns = [
        demonstration.times_s + RTDE_START_S, demonstration.joints, np.zeros(len(demonstration.times_s)),
        255 * demonstration.gripper,
    ]  # fmt: skip
    return write_table(path, header, columns)
