"""Export of a motion as an MCAP recording for Foxglove: joints, poses, images and calibrations as JSON messages.

Topics: `/joint_states` and `/joint_commands` (foxglove.JointStates), `/tf` (foxglove.FrameTransforms, every body and camera
below the frame "world"), `/camera/<name>/image` (foxglove.CompressedImage, JPEG) and `/camera/<name>/calibration`
(foxglove.CameraCalibration). Time 0 is the start of the motion.
"""

import base64
import io
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.conventions import xyzw_from_wxyz
from aomgen.core.camera import Camera
from aomgen.core.transforms import quat_from_matrix
from aomgen.core.values import Array
from aomgen.exports.scene_motion import SceneMotion
from aomgen.io.atomic import write_bytes
from aomgen.io.images import encode_jpeg

WORLD_FRAME: Final = "world"
JOINTS_TOPIC, COMMANDS_TOPIC, POSES_TOPIC = "/joint_states", "/joint_commands", "/tf"
# Message of a recording: topic, time [s], content.
Message = tuple[str, float, dict[str, Any]]


def _object(title: str, **properties: Any) -> dict[str, Any]:
    """Make the JSON schema of an object with only required properties."""
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


def _array(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_NUMBER, _INTEGER, _TEXT = {"type": "number"}, {"type": "integer"}, {"type": "string"}
_TIME: Final = _object("time", sec=_INTEGER, nsec=_INTEGER)
_TRANSFORM: Final = _object(
    "foxglove.FrameTransform",
    timestamp=_TIME,
    parent_frame_id=_TEXT,
    child_frame_id=_TEXT,
    translation=_object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER),
    rotation=_object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER),
)
_SCHEMAS: Final = (
    _object(
        "foxglove.JointStates",
        timestamp=_TIME,
        joints=_array(_object("foxglove.JointState", name=_TEXT, position=_NUMBER)),
    ),
    _object("foxglove.FrameTransforms", transforms=_array(_TRANSFORM)),
    _object(
        "foxglove.CompressedImage",
        timestamp=_TIME,
        frame_id=_TEXT,
        data=_TEXT | {"contentEncoding": "base64"},
        format=_TEXT,
    ),
    _object(
        "foxglove.CameraCalibration",
        timestamp=_TIME,
        frame_id=_TEXT,
        width=_INTEGER,
        height=_INTEGER,
        distortion_model=_TEXT,
        **{name: _array(_NUMBER) for name in "DKRP"},
    ),
)


def write_mcap(motion: SceneMotion, path: Path) -> None:
    """Write a motion as .mcap; needs the package `mcap`.

    Raises:
        MissingFileError, MalformedFileError: A video of the motion cannot be read.
        StorageError: Writing to the disk failed.
    """
    from mcap.writer import Writer

    buffer = io.BytesIO()
    writer = Writer(buffer)
    writer.start(profile="", library="aomgen")
    joints, poses, images, calibrations = (
        writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
        for schema in _SCHEMAS
    )
    kinds = {JOINTS_TOPIC: joints, COMMANDS_TOPIC: joints, POSES_TOPIC: poses}
    channels: dict[str, int] = {}
    messages = [*_list_states(motion), *_list_calibrations(motion), *_list_images(motion)]
    for number, (topic, time_s, content) in enumerate(sorted(messages, key=lambda item: item[1])):
        if topic not in channels:
            schema = kinds.get(topic, images if topic.endswith("/image") else calibrations)
            channels[topic] = writer.register_channel(topic, "json", schema)
        stamp = round(time_s * 1e9)
        writer.add_message(channels[topic], stamp, json.dumps(content).encode(), stamp, number)
    writer.finish()
    write_bytes(path, buffer.getvalue())


def _list_states(motion: SceneMotion) -> Iterator[Message]:
    """Yield joints, commands and poses of every frame."""
    moved, names = motion.trajectory, [*motion.robot.joint_names, "gripper", "object"]
    reached = np.column_stack([moved.joints, moved.gripper, moved.thetas])
    for frame, time_s in enumerate(_times(motion)):
        stamp = _stamp(time_s)
        yield JOINTS_TOPIC, time_s, {"timestamp": stamp, "joints": _joints(names, reached[frame])}
        # The command of a frame is the target at the end of the frame.
        commands = _joints(names[:-1], motion.commands[frame + 1])
        yield COMMANDS_TOPIC, time_s, {"timestamp": stamp, "joints": commands}
        bodies = dict(zip(motion.twin.body_names[1:], motion.Ts_world_body[frame, 1:], strict=True))
        cameras = {f"camera_{name}": camera.T_world_cam for name, camera in motion.cameras.items()}
        cameras |= {f"camera_{name}": path.Ts_world_cam[frame] for name, path in motion.paths.items()}
        transforms = [_transform(stamp, name, T) for name, T in {**bodies, **cameras}.items()]
        yield POSES_TOPIC, time_s, {"transforms": transforms}


def _list_calibrations(motion: SceneMotion) -> Iterator[Message]:
    views: Mapping[str, Camera] = {name: path.camera for name, path in motion.paths.items()}
    for name, camera in {**motion.cameras, **views}.items():
        projection = np.column_stack([camera.K, np.zeros(3)])
        content = {
            "timestamp": _stamp(0.0),
            "frame_id": f"camera_{name}",
            "width": camera.width,
            "height": camera.height,
            "distortion_model": "plumb_bob",
            "D": [0.0] * 5,
            "K": camera.K.ravel().tolist(),
            "R": np.eye(3).ravel().tolist(),
            "P": projection.ravel().tolist(),
        }
        yield f"/camera/{name}/calibration", 0.0, content


def _list_images(motion: SceneMotion) -> Iterator[Message]:
    """Yield the undistorted frames of all videos as JPEG, without those before the start of the motion."""
    first = float(motion.trajectory.times_s[0])
    for name in motion.videos:
        for video_s, image in motion.decode_video(name):
            time_s = video_s + motion.video_starts_s[name] - first
            if time_s < 0:
                continue
            data = base64.b64encode(encode_jpeg(image)).decode()
            content = {
                "timestamp": _stamp(time_s),
                "frame_id": f"camera_{name}",
                "data": data,
                "format": "jpeg",
            }
            yield f"/camera/{name}/image", time_s, content


def _times(motion: SceneMotion) -> list[float]:
    return (motion.trajectory.times_s - motion.trajectory.times_s[0]).tolist()


def _stamp(time_s: float) -> dict[str, int]:
    seconds, nanoseconds = divmod(round(time_s * 1e9), 10**9)
    return {"sec": seconds, "nsec": nanoseconds}


def _joints(names: list[str], values: Array) -> list[dict[str, Any]]:
    return [{"name": name, "position": float(x)} for name, x in zip(names, values, strict=True)]


def _transform(stamp: dict[str, int], name: str, T: Array) -> dict[str, Any]:
    quat = xyzw_from_wxyz(quat_from_matrix(T[:3, :3]))
    return {
        "timestamp": stamp,
        "parent_frame_id": WORLD_FRAME,
        "child_frame_id": name,
        "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "rotation": dict(zip("xyzw", quat.tolist(), strict=True)),
    }
