"""Synthetic captures: a complete recording with ground truth, from a category and a seed."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from aomgen.assets.make import make_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.motion import Direction
from aomgen.core.progress import Progress, silent
from aomgen.errors import ConfigError
from aomgen.io.atomic import staged_folder
from aomgen.io.robot_xml import read_robot_xml
from aomgen.robots.description import robot_references
from aomgen.robots.loading import load_robot
from aomgen.robots.robot import RobotModel
from aomgen.robots.robot_store import copy_robot_files
from aomgen.synthetic.capture_writer import Recording, write_recording, write_truth
from aomgen.synthetic.conditions import Conditions, demo_candidates, scan_cameras
from aomgen.synthetic.demo_video import RecordedVideo, choose_camera, draw_schedule, render_frames
from aomgen.synthetic.demonstration_search import Performance, find_demonstration
from aomgen.synthetic.grasp_selection import list_grasp_types
from aomgen.synthetic.layout import build_world
from aomgen.synthetic.scene_renderer import SceneRenderer, expose
from aomgen.synthetic.style import DemonstrationStyle, GraspType, draw_style

DEFAULT_ROBOT = "ur5e_2f85"
# A robot file may name meshes in folders beside its own, as packages do.
PACKAGE_DEPTH = 3
# What a capture of a category shows, where it is not the asset of that name.
SHOWN = {"drawer": "dresser"}


def make_capture(
    folder: Path,
    *,
    category: str,
    seed: int,
    conditions: Conditions | None = None,
    robot_file: Path | None = None,
    style: DemonstrationStyle | None = None,
    progress: Progress = silent,
) -> None:
    """Write a complete capture with `truth/`: a robot moves a made asset in a made room.

    The object moves by contact alone. The same arguments give the same files on one class of
    machine (pictures come from the OpenGL driver).

    Args:
        folder: Created or replaced.
        category: One of `assets.make.MAKERS`.
        seed: Chooses asset, room, places, path, cameras, noise and clock.
        conditions: Cameras and their flaws; those of `Conditions` when None.
        robot_file: URDF or MJCF of another robot, copied into the capture with all it refers to.
        style: How the robot demonstrates; a random pinch that opens the object when None.
        progress: Told about pictures.

    Raises:
        ConfigError: Unknown category, or no setting of this seed can be reached.
        InputError: The robot file cannot be used.
        BackendError: No OpenGL driver works.
        StorageError: The disk refuses.
    """
    rng = np.random.default_rng([seed, *category.encode(), 1])
    robot = load_robot(DEFAULT_ROBOT)
    if robot_file is not None:
        root = robot_file.resolve().parents[min(PACKAGE_DEPTH, len(robot_file.resolve().parents)) - 1]
        robot = load_robot(robot_file.resolve(), root=root)
    performance = find_demonstration(robot, draw_object(category, seed), rng, style)
    progress(0.05, "demonstration simulated")
    recording = record(robot, performance, conditions or Conditions(), rng, progress=progress)
    with staged_folder(folder) as staging:
        source = f'model = "{DEFAULT_ROBOT}"'
        if robot_file is not None:
            file = robot_file.resolve()
            copied = copy_robot_files(file, robot_references(file, root), staging / "robot")
            source = f'{read_robot_xml(file, root).kind} = "{copied.relative_to(staging).as_posix()}"'
        write_recording(staging, recording, source)
        write_truth(staging / "truth", recording)


def draw_object(category: str, seed: int) -> ArticulatedAsset:
    """The object of a capture.

    Raises:
        ConfigError: Unknown category.
    """
    return make_asset(SHOWN.get(category, category), seed)


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
    chosen = allowed.get(touch)
    if chosen is None:
        what = f"{touch!r} is none that a {category} allows when {direction}"
        raise ConfigError("touch", what, f"choose {' or '.join(known)}")
    rng = np.random.default_rng([seed, *category.encode(), 3])
    style = draw_style(asset, rng, direction=direction, touch=chosen)
    usual = DemonstrationStyle(travel=style.travel)
    return replace(
        style,
        before_s=max(style.before_s, usual.before_s),
        after_s=max(style.after_s, usual.after_s),
    )


def record(
    robot: RobotModel,
    performance: Performance,
    conditions: Conditions,
    rng: np.random.Generator,
    *,
    progress: Progress = silent,
) -> Recording:
    """Record a performance: stills of the scene at rest, a video, a joint log with its own clock."""
    demonstration, layout = performance.demonstration, performance.layout
    schedule = draw_schedule(robot, performance, conditions, rng)
    cameras = scan_cameras(layout, conditions, rng)
    with SceneRenderer(build_world(robot, layout, visual=True), conditions.size) as painter:
        demo_camera = choose_camera(
            painter, demo_candidates(layout, conditions, rng), demonstration, schedule
        )
        images, labels = [], []
        for number, camera in enumerate(cameras):
            gain = 1 + rng.uniform(-conditions.gain_spread, conditions.gain_spread)
            images.append(expose(painter.draw(camera, demonstration.qpos[0]), gain, conditions.noise, rng))
            labels.append(painter.labels(camera, demonstration.qpos[0]))
            progress(0.05 + 0.35 * number / len(cameras), "stills")
        frames, frame_labels = render_frames(
            painter, demo_camera, demonstration, schedule, conditions, rng,
            progress=lambda share, what: progress(0.4 + 0.6 * share, what),
        )  # fmt: skip
    return Recording(
        name=layout.asset.name,
        category=layout.asset.category,
        performance=performance,
        scan_cameras=cameras,
        scan_images=images,
        scan_labels=labels,
        video=RecordedVideo(schedule=schedule, camera=demo_camera, frames=frames, labels=frame_labels),
        conditions=conditions,
    )
