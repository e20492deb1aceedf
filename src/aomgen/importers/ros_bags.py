"""Episodes of ROS 1 bags, ROS 2 bags (SQLite and MCAP) and MCAP files, read with `rosbags`.

Messages are decoded with the definitions of `rosbags`, not with those in the file, because `rosbags` would generate and
execute code from the latter.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from aomgen.errors import (
    AomgenError,
    BackendError,
    IncompleteCaptureError,
    LimitExceededError,
    MalformedFileError,
    quote_error,
)
from aomgen.importers.camera_names import make_camera_name
from aomgen.importers.recorded import JointTable, RecordedEpisode, RecordedVideo, WrittenVideo
from aomgen.importers.ros_images import read_image_message
from aomgen.importers.video_writing import encode_frames, write_h264

BagKind = Literal["ROS 1 bag", "ROS 2 bag", "MCAP", "ROS 2 database"]
JOINT_STATE: Final = "sensor_msgs/msg/JointState"
IMAGES: Final = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
H264: Final = "foxglove_msgs/msg/CompressedVideo"
# Messages with a single number, as some grippers publish.
NUMBERS: Final = tuple(
    f"std_msgs/msg/{kind}"
    for kind in ("Float32", "Float64", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32")
)
# Definition of Foxglove's message, which is not part of any ROS distribution.
_H264_DEFINITION: Final = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
# Largest number of rows: half an hour at 1 kHz, far longer than any demonstration.
MAX_ROWS: Final = 2_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenBag:
    """A bag that is open for reading.

    Attributes:
        reader: Reader of `rosbags`.
        decode: Function that returns the message for its bytes and type.
        topics: Types by topic, for topics with messages.
        empty: Types by topic, for topics without messages.
    """

    reader: Any
    decode: Callable[[bytes, str], Any]
    topics: dict[str, str]
    empty: dict[str, str]

    def read_messages(self, *topics: str) -> Iterator[tuple[str, float, float, Any]]:
        """Yield topic, time stamp and recording time, [s], and message of every message of some topics.

        The time stamp is that of the header; it is 0 if the type has no header.
        """
        wanted = [item for item in self.reader.connections if item.topic in topics]
        for connection, recorded_ns, data in self.reader.messages(connections=wanted):
            message = self.decode(data, connection.msgtype)
            header = getattr(message, "header", None)
            stamp = getattr(message, "timestamp", None) if header is None else header.stamp
            stamp_s = 0.0 if stamp is None else stamp.sec + stamp.nanosec / 1e9
            yield connection.topic, stamp_s, recorded_ns / 1e9, message


@cache
def _load_types(ros1: bool) -> Any:
    """Load the message types of ROS 1 or ROS 2; the compilation of their definitions takes a second."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg(_H264_DEFINITION, H264))
    return types


@contextmanager
def open_bag(path: Path, kind: BagKind) -> Iterator[OpenBag]:
    """Open a bag; all errors of `rosbags` are converted to one type.

    Raises:
        BackendError: `rosbags` is not installed.
        MalformedFileError: The bag is damaged; also raised if the damage is found while the block reads.
        IncompleteCaptureError: The bag has no messages.
    """
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
    except ImportError as error:
        raise BackendError("rosbags", "is not installed", "pip install 'aomgen[ros]'") from error
    ros1 = kind == "ROS 1 bag"
    types = _load_types(ros1)
    # The kind is recognized from the content, because a file may have any suffix.
    plugin: Any = {
        "ROS 1 bag": Reader1,
        "ROS 2 bag": Reader2.STORAGE_PLUGINS["dir"],
        "MCAP": Reader2.STORAGE_PLUGINS[".mcap"],
        "ROS 2 database": Reader2.STORAGE_PLUGINS[".db3"],
    }[kind]
    try:
        reader = plugin(path)
        reader.open()
        try:
            topics = {item.topic: item.msgtype for item in reader.connections if item.msgcount}
            empty = {item.topic: item.msgtype for item in reader.connections if item.topic not in topics}
            if not topics:
                raise IncompleteCaptureError(path, "holds no messages", "record the demonstration again")
            yield OpenBag(
                reader=reader,
                decode=types.deserialize_ros1 if ros1 else types.deserialize_cdr,
                topics=topics,
                empty=empty,
            )
        finally:
            reader.close()
    except (AomgenError, GeneratorExit, PermissionError):
        raise
    # For damaged bags the library does not catch the errors of its parsers, SQLite and the decompressors.
    except Exception as error:
        raise MalformedFileError(
            path, f"is not readable as {kind} ({quote_error(error)})", "copy or record it again"
        ) from error


def read_episode(path: Path, kind: BagKind) -> RecordedEpisode:
    """Read the joint states of a bag; its videos are written later.

    Raises:
        BackendError, MalformedFileError, IncompleteCaptureError: See `open_bag`.
        LimitExceededError: The bag has more joint states than `MAX_ROWS`.
    """
    with open_bag(path, kind) as bag:
        tables, notes = _read_tables(bag, path)
        notes += [
            f"{topic} is taken as depth and left out"
            for topic, message_type in bag.topics.items()
            if message_type in IMAGES and "depth" in topic.lower()
        ]
        if not tables:
            listed = ", ".join(f"{topic} ({kind})" for topic, kind in list(bag.topics.items())[:20])
            raise IncompleteCaptureError(
                path, f"holds no joint states (topics: {listed})", f"record a {JOINT_STATE}"
            )
        videos = _list_videos(bag.topics, path, kind) or _list_videos(bag.empty, path, kind)
    return RecordedEpisode(kind=kind, tables=tuple(tables), videos=videos, notes=tuple(notes))


def _list_videos(topics: dict[str, str], path: Path, kind: BagKind) -> tuple[RecordedVideo, ...]:
    """List the videos of some topics; a video without messages is refused when it is written."""
    return tuple(
        RecordedVideo(
            name=make_camera_name(topic), source=topic, write=partial(_write_video, path, kind, topic)
        )
        for topic, message_type in topics.items()
        if message_type in (*IMAGES, H264) and "depth" not in topic.lower()
    )


def _read_tables(bag: OpenBag, path: Path) -> tuple[list[JointTable], list[str]]:
    """Return a table for each topic and each set of joint names in it, because arm and gripper may share a topic."""
    groups: dict[tuple[str, ...], list[tuple[float, float, list[float]]]] = {}
    wanted = [topic for topic, kind in bag.topics.items() if kind in (JOINT_STATE, *NUMBERS)]
    for count, (topic, stamp_s, recorded_s, message) in enumerate(
        bag.read_messages(*wanted) if wanted else ()
    ):
        if not count < MAX_ROWS:
            raise LimitExceededError(path, f"has more than {MAX_ROWS} joint states", "cut the recording")
        if bag.topics[topic] in NUMBERS:
            names, values = [topic], [float(message.data)]
        else:
            names, values = (
                [str(name) for name in message.name],
                np.asarray(message.position, np.float64).tolist(),
            )
            if not names or not values:
                continue  # a message with only velocities or efforts
            if len(set(names)) != len(names) or len(names) != len(values):
                raise MalformedFileError(
                    path,
                    f"has {len(values)} positions for the joints {names} on {topic}",
                    "correct its publisher",
                )
        ordered = sorted(zip(names, values, strict=True))
        row = stamp_s, recorded_s, [value for _, value in ordered]
        groups.setdefault((topic, *(name for name, _ in ordered)), []).append(row)
    tables, notes = [], []
    for (topic, *names), rows in groups.items():
        times, recorded = np.array([row[:2] for row in rows]).T
        if not np.ptp(times) > 0:
            times = recorded
            notes.append(f"{topic} has no time stamps; the times of recording are taken")
        values = np.array([row[2] for row in rows])
        columns = dict(zip(names, values.T, strict=True))
        unit = "rad" if bag.topics[topic] == JOINT_STATE else ""
        tables.append(JointTable(name=topic, times_s=times, columns=columns, unit=unit, recorded_s=recorded))
    return tables, notes


def _write_video(path: Path, kind: BagKind, topic: str, target: Path) -> WrittenVideo:
    """Write the images or H.264 packets of a topic."""
    with open_bag(path, kind) as bag:
        source = f"{path}, {topic}"
        # Drivers stamp either all or none of their messages.
        messages = (
            (stamp_s if stamp_s > 0 else recorded_s, message)
            for _, stamp_s, recorded_s, message in bag.read_messages(topic)
        )
        if (bag.topics | bag.empty)[topic] == H264:
            return write_h264(_list_packets(messages, source), target, source)
        frames = ((time_s, read_image_message(message, source)) for time_s, message in messages)
        return encode_frames(frames, target, source)


def _list_packets(messages: Iterator[tuple[float, Any]], source: str) -> Iterator[tuple[float, bytes]]:
    for time_s, message in messages:
        if message.format.lower() not in ("h264", "avc", "h.264"):
            raise MalformedFileError(source, f"has video of format '{message.format}'", "record it as h264")
        yield time_s, bytes(message.data)
