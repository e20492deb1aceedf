"""Synthetic captures: complete capture folders with `truth/`, from a category and a seed (see docs/capture.md)."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from aomgen.assets.choice import make_asset
from aomgen.conventions import PART_LABELS
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.joint import Joint
from aomgen.core.motion import Direction
from aomgen.core.progress import Progress, silent
from aomgen.core.recording import JointLog
from aomgen.core.values import Array
from aomgen.errors import ConfigError
from aomgen.io.artifact import save_artifact
from aomgen.io.atomic import stage_folder, write_bytes, write_json, write_text
from aomgen.io.images import encode_jpeg, encode_png
from aomgen.io.mujoco_model import read_robot_xml
from aomgen.io.video import encode_video
from aomgen.robots.description import robot_references
from aomgen.robots.loading import copy_robot_files, load_robot
from aomgen.simulation.scene import Scene
from aomgen.simulation.scene_renderer import SceneRenderer
from synthetic.demonstration_search import find_demonstration
from synthetic.grasp_selection import list_grasp_types
from synthetic.scene_recording import Conditions, Recording, record
from synthetic.style import MOVED, DemonstrationStyle, GraspType, draw_style

DEFAULT_ROBOT = "ur5e_2f85"
# A robot file may name meshes in folders beside its own, as packages do.
PACKAGE_DEPTH = 3
# Asset of a category's capture, where it is not the asset of that name.
SHOWN = {"drawer": "dresser"}
# Style of that asset; objects of all styles replace it.
SHOWN_STYLE = "classic"
CAMERA = "front"
VERBS = {"opening": "open", "closing": "close"}
MOVED_TEXT = {"revolute": "0.5 degrees", "prismatic": "2 mm"}


def make_capture(
    folder: Path,
    *,
    category: str,
    seed: int,
    conditions: Conditions | None = None,
    robot_file: Path | None = None,
    style: DemonstrationStyle | None = None,
    renderer: Callable[[Scene, tuple[int, int]], SceneRenderer] = SceneRenderer,
    progress: Progress = silent,
) -> None:
    """Write a complete capture with `truth/`: a robot moves a made asset in a made room.

    The object moves by contact alone. The same arguments give the same files on one class of
    machine (images come from the OpenGL driver).

    Args:
        folder: Created or replaced.
        category: One of `assets.choice.MAKERS`.
        seed: Chooses asset, room, places, path, cameras, noise and clock.
        conditions: Cameras and their errors; those of `Conditions` when None.
        robot_file: URDF or MJCF of another robot, copied into the capture with all it refers to.
        style: Style of the demonstration; None selects a random pinch that opens the object.
        renderer: Draws the images of a compiled scene up to a size.
        progress: Receives the progress of the images.

    Raises:
        ConfigError: Unknown category, or no setting of this seed can be reached.
        InputError: The robot file cannot be used.
        BackendError: No OpenGL driver works.
        StorageError: The disk refuses.
    """
    rng = capture_rng(category, seed)
    file = None if robot_file is None else robot_file.resolve()
    root = None if file is None else file.parents[min(PACKAGE_DEPTH, len(file.parents)) - 1]
    robot = load_robot(file or DEFAULT_ROBOT, root=root)
    performance = find_demonstration(robot, draw_object(category, seed), rng, style)
    progress(0.05, "demonstration simulated")
    recording = record(
        robot, performance, conditions or Conditions(), rng, renderer=renderer, progress=progress
    )
    with stage_folder(folder) as staging:
        source = f'model = "{DEFAULT_ROBOT}"'
        if file is not None and root is not None:
            copied = copy_robot_files(file, robot_references(file, root), staging / "robot")
            source = f'{read_robot_xml(file, root).kind} = "{copied.relative_to(staging).as_posix()}"'
        _write_recording(staging, recording, source)
        _write_truth(staging / "truth", recording)


def capture_rng(category: str, seed: int) -> np.random.Generator:
    """Random generator of everything of a capture but its object, the layout first."""
    return np.random.default_rng([seed, *category.encode(), 1])


def draw_object(category: str, seed: int) -> ArticulatedAsset:
    """The object of a capture.

    Raises:
        ConfigError: Unknown category.
    """
    return make_asset(SHOWN.get(category, category), seed, SHOWN_STYLE)


def draw_capture_style(
    category: str, seed: int, direction: Direction, touch: str
) -> DemonstrationStyle | None:
    """The style of a capture that closes, hooks or pushes; None for the usual pinch that opens.

    The video begins and ends with the arm at rest, as people record.

    Raises:
        ConfigError: Unknown category or touch, or this part cannot be touched so.
    """
    if direction == "opening" and touch == "pinch":
        return None
    asset = draw_object(category, seed)
    known = list_grasp_types(asset, direction)
    allowed: dict[str, GraspType] = {name: name for name in known}
    if touch not in allowed:
        what = f"{touch!r} is none that a {category} allows when {direction}"
        raise ConfigError("touch", what, f"choose {' or '.join(known)}")
    rng = np.random.default_rng([seed, *category.encode(), 3])
    style = draw_style(asset, rng, direction=direction, touch=allowed[touch])
    usual = DemonstrationStyle(travel=style.travel)
    before_s, after_s = max(style.before_s, usual.before_s), max(style.after_s, usual.after_s)
    return replace(style, before_s=before_s, after_s=after_s)


def _write_recording(folder: Path, recording: Recording, robot: str) -> None:
    """Write capture.toml, in which a line names the robot, scan, video and joint log."""
    video = recording.video
    for number, image in enumerate(recording.scan_images):
        write_bytes(folder / "scan" / f"{number:04d}.jpg", encode_jpeg(image, 93))
    film = encode_video(video.frames, recording.conditions.fps, crf=17)
    write_bytes(folder / "demo" / f"{CAMERA}.mp4", film)
    write_text(folder / "demo" / "joints.csv", joints_csv(video.schedule.log))
    write_text(folder / "capture.toml", _capture_toml(recording, robot))


def _write_truth(folder: Path, recording: Recording) -> None:
    """Write truth.json, label images and the asset itself (`asset.json` and `.npz`)."""
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
    asset = recording.performance.layout.asset
    text = f"""\
format = 1
name = "{asset.name}"
category = "{asset.category}"
instruction = "{VERBS[recording.performance.style.direction]} the {asset.category}"

[robot]
{robot}
joints = [{names}]
gripper = "gripper"
scan_state = "first_row"

[scan]
images = "scan"
intrinsics = {_intrinsics(recording.scan_cameras[0])}

[[demo.cameras]]
name = "{CAMERA}"
video = "demo/{CAMERA}.mp4"
intrinsics = {_intrinsics(recording.video.camera)}

[demo]
joints = "demo/joints.csv"
"""
    for part in ("robot", "static", "moving"):
        for number in _clearest(recording.scan_labels, PART_LABELS[part]):
            (x, y), bounds = make_prompt(recording.scan_labels[number] == PART_LABELS[part])
            text += f'\n[[prompts]]\npart = "{part}"\nimage = "{number:04d}.jpg"\n'
            text += f"points = [[{x}, {y}, 1]]\nbox = {bounds}\n"
    return text


def _clearest(labels: list[NDArray[np.uint8]], label: int) -> tuple[int, int]:
    """The two images, as the capture format asks, that show most of a part and cut little off at the border."""
    scores = []
    for image in labels:
        mask = image == label
        border = mask[0].sum() + mask[-1].sum() + mask[:, 0].sum() + mask[:, -1].sum()
        scores.append(mask.sum() - 20.0 * border)
    # Two neighbours would show the same view, so that the second is taken from another stretch.
    first = int(np.argmax(scores))
    far = np.abs(np.arange(len(scores)) - first) > len(scores) // 8
    return first, int(np.argmax(np.where(far, scores, -np.inf)))


def make_prompt(mask: NDArray[np.bool_]) -> tuple[list[float], list[float]]:
    """Click of a person: the pixel deepest inside a mask (H, W), and the mask's box, [px]."""
    depth = np.asarray(distance_transform_edt(np.pad(mask, 1)))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(depth)), mask.shape)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    bounds = [float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1)]
    return [float(column) + 0.5, float(row) + 0.5], bounds


def _intrinsics(camera: Camera) -> list[float]:
    return [camera.fx, camera.fy, camera.cx, camera.cy]
