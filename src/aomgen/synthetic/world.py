"""Synthetic captures: a complete recording with ground truth, from a category and a seed."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.assets.make import make_asset
from aomgen.conventions import MOVING
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.joint_log import JointLog
from aomgen.core.progress import Progress, silent
from aomgen.core.robot_choice import HandChoice
from aomgen.core.values import Array
from aomgen.errors import ConfigError
from aomgen.io.atomic import staged_folder
from aomgen.io.robot_xml import read_robot_xml
from aomgen.physics.robot import RobotModel, load_robot
from aomgen.physics.robot_store import copy_robot_files
from aomgen.synthetic.conditions import Conditions
from aomgen.synthetic.demonstration import Demonstration, simulate
from aomgen.synthetic.pictures import Painter, exposed
from aomgen.synthetic.planning import CONTROL_STEP_S, Script, plan
from aomgen.synthetic.setting import Setting, build_world, draw_setting
from aomgen.synthetic.viewpoints import demo_candidates, scan_cameras
from aomgen.synthetic.write import write_recording, write_truth

DEFAULT_ROBOT = "ur5e_2f85"
# A robot file may name meshes in folders beside its own, as packages do.
PACKAGE_DEPTH = 3
LOG_RATE_HZ = 100
JOINT_NOISE_RAD = 0.0005
GRIPPER_NOISE = 0.001
MAX_TRIES = 80
# Shares of the rest phases at both ends that only the log has seen.
LEAD_S, TAIL_S = (0.2, 0.6), (0.1, 0.3)


@dataclass(frozen=True, slots=True, kw_only=True)
class Performance:
    """A demonstration that succeeded, in its setting."""

    setting: Setting
    script: Script
    demonstration: Demonstration


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """Everything a synthetic capture holds.

    Attributes:
        name, category: Of the capture.
        performance: Setting and demonstration.
        scan_cameras, scan_images, scan_labels: One entry a still; images (H, W, 3), labels (H, W).
        demo_camera: The fixed camera.
        frames, frame_labels: Of the video.
        frame_steps: Simulation step of each frame.
        conditions: How everything was filmed.
        log: Noisy joint log, own clock.
        clock_offset_s: Log time = video time + offset.
    """

    name: str
    category: str
    performance: Performance
    scan_cameras: list[Camera]
    scan_images: list[NDArray[np.uint8]]
    scan_labels: list[NDArray[np.uint8]]
    demo_camera: Camera
    frames: list[NDArray[np.uint8]]
    frame_labels: list[NDArray[np.uint8]]
    frame_steps: NDArray[np.int64]
    conditions: Conditions
    log: JointLog
    clock_offset_s: float


def make_capture(
    folder: Path,
    *,
    category: str,
    seed: int,
    conditions: Conditions | None = None,
    robot_file: Path | None = None,
    hand: HandChoice | None = None,
    progress: Progress = silent,
) -> None:
    """Write a complete capture with `truth/`: a robot opens a made asset in a made room.

    The object moves by contact alone. The same arguments give the same files on one class of
    machine (pictures come from the OpenGL driver).

    Args:
        folder: Created or replaced.
        category: One of `assets.make.MAKERS`.
        seed: Chooses asset, room, places, path, cameras, noise and clock.
        conditions: Cameras and their flaws; those of `Conditions` when None.
        robot_file: URDF or MJCF of another robot, copied into the capture with all it refers to.
        hand: What its file does not tell about its hand.
        progress: Told about pictures.

    Raises:
        ConfigError: Unknown category, or no setting of this seed can be reached.
        InputError: The robot file cannot be used.
        BackendError: No OpenGL driver works.
        StorageError: The disk refuses.
    """
    rng = np.random.default_rng([seed, *category.encode(), 1])
    hand = hand or HandChoice()
    robot = load_robot(DEFAULT_ROBOT)
    if robot_file is not None:
        root = robot_file.resolve().parents[min(PACKAGE_DEPTH, len(robot_file.resolve().parents)) - 1]
        robot = load_robot(robot_file.resolve(), hand=hand, root=root)
    performance = perform(robot, make_asset(category, seed), rng)
    progress(0.05, "demonstration simulated")
    recording = record(robot, performance, conditions or Conditions(), rng, progress=progress)
    with staged_folder(folder) as staging:
        source = f'model = "{DEFAULT_ROBOT}"'
        if robot_file is not None:
            xml = read_robot_xml(robot_file.resolve(), root)
            copied = copy_robot_files(xml.path, xml.references, staging / "robot")
            source = f'{xml.kind} = "{copied.relative_to(staging).as_posix()}"'
        write_recording(staging, recording, source, hand)
        write_truth(staging / "truth", recording)


def perform(robot: RobotModel, asset: ArticulatedAsset, rng: np.random.Generator) -> Performance:
    """Draw settings until one demonstration opens the object by contact with the handle alone.

    Raises:
        ConfigError: None of MAX_TRIES does.
    """
    for _ in range(MAX_TRIES):
        setting = draw_setting(asset, rng)
        world = build_world(robot, setting, visual=False)
        script = plan(robot, world, setting, rng)
        if script is None:
            continue
        demonstration = simulate(robot, world, script)
        if not demonstration.diverged and not demonstration.foreign and _opened(demonstration, script):
            return Performance(setting=setting, script=script, demonstration=demonstration)
    raise ConfigError(asset.name, f"no demonstration succeeds in {MAX_TRIES} settings", "choose another seed")


def _opened(demonstration: Demonstration, script: Script) -> bool:
    """Whether at least 90 % of the goal is reached, and kept within 10 % after release."""
    goal = script.theta_goal
    return bool(demonstration.theta.max() >= 0.9 * goal and abs(demonstration.theta[-1] - goal) <= 0.1 * goal)


def record(
    robot: RobotModel,
    performance: Performance,
    conditions: Conditions,
    rng: np.random.Generator,
    *,
    progress: Progress = silent,
) -> Recording:
    """Film a performance: stills of the scene at rest, a video, a joint log with its own clock."""
    demonstration, setting = performance.demonstration, performance.setting
    start = rng.uniform(*LEAD_S)
    end = demonstration.times_s[-1] - rng.uniform(*TAIL_S)
    frame_times = start + np.arange(int((end - start) * conditions.fps)) / conditions.fps
    steps = np.round(frame_times / CONTROL_STEP_S).astype(np.int64)
    clock_shift = rng.uniform(0.0, 2.0)
    log = _log(robot, demonstration, clock_shift, rng)
    world = build_world(robot, setting, visual=True)
    cameras = scan_cameras(setting, conditions, rng)
    with Painter(robot, world, *conditions.size) as painter:
        demo_camera = _best_camera(painter, demo_candidates(setting, conditions, rng), demonstration, steps)
        images, labels, frames, frame_labels = [], [], [], []
        for number, camera in enumerate(cameras):
            gain = 1 + rng.uniform(-conditions.gain_spread, conditions.gain_spread)
            images.append(exposed(painter.draw(camera, demonstration.qpos[0]), gain, conditions.noise, rng))
            labels.append(painter.labels(camera, demonstration.qpos[0]))
            progress(0.05 + 0.35 * number / len(cameras), "stills")
        for number, step in enumerate(steps):
            clean = painter.draw(demo_camera, demonstration.qpos[step])
            frames.append(exposed(clean, 1.0, conditions.noise, rng))
            frame_labels.append(painter.labels(demo_camera, demonstration.qpos[step]))
            progress(0.4 + 0.6 * number / len(steps), "video")
    return Recording(
        name=setting.asset.name,
        category=setting.asset.category,
        performance=performance,
        scan_cameras=cameras,
        scan_images=images,
        scan_labels=labels,
        demo_camera=demo_camera,
        frames=frames,
        frame_labels=frame_labels,
        frame_steps=steps,
        conditions=conditions,
        log=log,
        clock_offset_s=float(start + clock_shift),
    )


def _log(
    robot: RobotModel, demonstration: Demonstration, clock_shift: float, rng: np.random.Generator
) -> JointLog:
    every = round(1.0 / (LOG_RATE_HZ * CONTROL_STEP_S))
    joints: Array = demonstration.joints[::every]
    gripper = demonstration.gripper[::every] + GRIPPER_NOISE * rng.standard_normal(len(joints))
    return JointLog(
        times_s=demonstration.times_s[::every] + clock_shift,
        joints=joints + JOINT_NOISE_RAD * rng.standard_normal(joints.shape),
        gripper=np.clip(gripper, 0.0, 1.0),
        joint_names=robot.joint_names,
    )


def _best_camera(
    painter: Painter, candidates: list[Camera], demonstration: Demonstration, steps: NDArray[np.int64]
) -> Camera:
    """The candidate that sees most of the moving part, at its worst moment of three."""
    moments = steps[np.linspace(0, len(steps) - 1, 3).astype(int)]
    seen = [
        min(int((painter.labels(camera, demonstration.qpos[step]) == MOVING).sum()) for step in moments)
        for camera in candidates
    ]
    return candidates[int(np.argmax(seen))]
