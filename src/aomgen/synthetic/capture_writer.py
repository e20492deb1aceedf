"""Synthetic recordings as capture folders, with `truth/` (see CAPTURE_FORMAT)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from aomgen.conventions import PART_LABELS
from aomgen.core.camera import Camera
from aomgen.core.joint import Joint
from aomgen.core.joint_log import JointLog
from aomgen.core.values import Array
from aomgen.io.artifact import save_artifact
from aomgen.io.atomic import write_bytes, write_json, write_text
from aomgen.io.images import encode_jpeg, encode_png
from aomgen.io.video import encode_video
from aomgen.synthetic.conditions import Conditions
from aomgen.synthetic.demo_video import RecordedVideo
from aomgen.synthetic.demonstration_search import Performance
from aomgen.synthetic.style import MOVED

CAMERA = "front"
# Images that a person clicks on for each part, as the capture format asks.
PROMPT_IMAGES = 2
VERBS = {"opening": "open", "closing": "close"}
MOVED_TEXT = {"revolute": "0.5 degrees", "prismatic": "2 mm"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """Everything a synthetic capture holds.

    Attributes:
        scan_cameras, scan_images, scan_labels: One entry a still; images (H, W, 3), labels (H, W).
        video: Of the fixed camera, with the joint log.
    """

    name: str
    category: str
    performance: Performance
    scan_cameras: list[Camera]
    scan_images: list[NDArray[np.uint8]]
    scan_labels: list[NDArray[np.uint8]]
    video: RecordedVideo
    conditions: Conditions


def write_recording(folder: Path, recording: Recording, robot: str) -> None:
    """Write capture.toml, scan, video and joint log.

    Args:
        robot: The line of capture.toml that names the robot.

    Raises:
        StorageError: The disk refuses.
    """
    for number, image in enumerate(recording.scan_images):
        write_bytes(folder / "scan" / f"{number:04d}.jpg", encode_jpeg(image, 93))
    write_bytes(
        folder / "demo" / f"{CAMERA}.mp4",
        encode_video(recording.video.frames, recording.conditions.fps, crf=17),
    )
    write_text(folder / "demo" / "joints.csv", joints_csv(recording.video.schedule.log))
    write_text(folder / "capture.toml", _capture_toml(recording, robot))


def write_truth(folder: Path, recording: Recording) -> None:
    """Write truth.json, label images and the asset itself (`asset.json` and `.npz`).

    Raises:
        StorageError: The disk refuses.
    """
    for name, labels in (("scan", recording.scan_labels), (CAMERA, recording.video.labels)):
        for number, image in enumerate(labels):
            write_bytes(folder / "masks" / name / f"{number:04d}.png", encode_png(image))
    save_artifact(folder, "asset", recording.performance.layout.asset)
    write_json(folder / "truth.json", _answers(recording))


def _answers(recording: Recording) -> dict[str, Any]:
    performance = recording.performance
    layout, demonstration = performance.layout, performance.demonstration
    steps = recording.video.schedule.steps
    joint, theta = performance.joint, performance.theta[steps]
    start, end = find_moved_range(theta, joint)
    Ts_world_moving = layout.joint_world.motion(demonstration.theta[steps]) @ layout.T_world_object
    contacts = [
        [
            {"finger": c.finger, "point": c.point, "normal": c.normal, "force": c.force}
            for c in demonstration.contacts[step]
        ]
        for step in steps
    ]
    return {
        "format": 1,
        "world": "root frame of the robot model (ROS base_link): metres, z up",
        "scan": {f"{i:04d}.jpg": camera.T_world_cam for i, camera in enumerate(recording.scan_cameras)},
        "demo_cameras": {CAMERA: recording.video.camera.T_world_cam},
        "intrinsics": {"scan": _intrinsics(recording.scan_cameras[0]), CAMERA: _intrinsics(recording.video.camera)},
        "joint": {"type": joint.type, "axis": joint.axis, "origin": joint.origin, "lower": joint.lower, "upper": joint.upper},
        "direction": performance.style.direction,
        "theta": {CAMERA: theta},
        "start_frame": start,
        "end_frame": end,
        "start_end_rule": f"first frame more than {MOVED_TEXT[joint.type]} from the first value, last frame that far from the last",
        "contacts": contacts,
        "contacts_rule": "contacts of the hand with the moving part; normal from the hand into the part, force its component [N]",
        "clock_offset_s": recording.video.schedule.clock_offset_s,
        "object": {"asset": "asset.json", "T_world_object": layout.T_world_object, "scale": 1.0, "value": performance.style.start},
        "qpos": demonstration.joints[steps],
        "gripper": demonstration.gripper[steps],
        "Ts_world_moving": Ts_world_moving,
    }  # fmt: skip


def find_moved_range(theta: Array, joint: Joint) -> tuple[int | None, int | None]:
    """First frame that has left the first value and last frame away from the last one; None if none has."""
    limit = MOVED[joint.type]
    away_from_start = np.flatnonzero(np.abs(theta - theta[0]) > limit)
    away_from_end = np.flatnonzero(np.abs(theta - theta[-1]) > limit)
    if not (len(away_from_start) and len(away_from_end)):
        return None, None
    return int(away_from_start[0]), int(away_from_end[-1])


def joints_csv(log: JointLog) -> str:
    """Content of a joint log's file."""
    rows = [",".join(["time_s", *log.joint_names, "gripper"])]
    for time, joints, gripper in zip(log.times_s, log.joints, log.gripper, strict=True):
        rows.append(",".join([f"{time:.4f}", *(f"{q:.6f}" for q in joints), f"{gripper:.4f}"]))
    return "\n".join(rows) + "\n"


def _capture_toml(recording: Recording, robot: str) -> str:
    names = ", ".join(f'"{name}"' for name in recording.video.schedule.log.joint_names)
    lines = [
        "format = 1",
        f'name = "{recording.name}"',
        f'category = "{recording.category}"',
        f'instruction = "{VERBS[recording.performance.style.direction]} the {recording.category}"',
        "",
        "[robot]",
        robot,
        f"joints = [{names}]",
        'gripper = "gripper"',
        'scan_state = "first_row"',
        "",
        "[scan]",
        'images = "scan"',
        *_stated(recording, recording.scan_cameras[0]),
        "",
        "[[demo.cameras]]",
        f'name = "{CAMERA}"',
        f'video = "demo/{CAMERA}.mp4"',
        *_stated(recording, recording.video.camera),
        "",
        "[demo]",
        'joints = "demo/joints.csv"',
    ]
    for part in ("robot", "static", "moving"):
        for number in _clearest(recording.scan_labels, PART_LABELS[part]):
            mask = recording.scan_labels[number] == PART_LABELS[part]
            point, bounds = make_prompt(mask)
            lines += ["", "[[prompts]]", f'part = "{part}"', f'image = "{number:04d}.jpg"']
            lines += [f"points = [[{point[0]}, {point[1]}, 1]]", f"box = {bounds}"]
    return "\n".join(lines) + "\n"


def _stated(recording: Recording, camera: Camera) -> list[str]:
    return [f"intrinsics = {_intrinsics(camera)}"] if recording.conditions.intrinsics_known else []


def _clearest(labels: list[NDArray[np.uint8]], label: int) -> list[int]:
    """The images that show most of a part, cut off by the border as little as possible."""
    scores = []
    for image in labels:
        mask = image == label
        border = mask[0].sum() + mask[-1].sum() + mask[:, 0].sum() + mask[:, -1].sum()
        scores.append(mask.sum() - 20.0 * border)
    # Two neighbours would show the same view, so that the second is taken from another stretch.
    first = int(np.argmax(scores))
    far = np.abs(np.arange(len(scores)) - first) > len(scores) // 8
    second = int(np.argmax(np.where(far, scores, -np.inf)))
    return [first, second][:PROMPT_IMAGES]


def make_prompt(mask: NDArray[np.bool_]) -> tuple[list[float], list[float]]:
    """What a person would click: the pixel deepest inside a mask (H, W), and the mask's box, [px]."""
    depth = np.asarray(distance_transform_edt(np.pad(mask, 1)))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(depth)), mask.shape)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    bounds = [float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1)]
    return [float(column) + 0.5, float(row) + 0.5], bounds


def _intrinsics(camera: Camera) -> list[float]:
    return [camera.fx, camera.fy, camera.cx, camera.cy]
