"""Cheap worlds for AOMotion alone: a filmed demonstration, and upstream results as wrong as real ones are.

The demonstration is simulated (the object moves by contact alone) and filmed as captures are; scene,
labels, camera and clock are true ones perturbed by `motion_upstream.Upstream`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.assets.make import make_asset
from aomgen.benchmarks.motion_scan import Surface, learned, raw_gaussians, seen_surface
from aomgen.benchmarks.motion_upstream import Upstream, draw_misplacement, given_scene, mislabelled
from aomgen.benchmarks.truth import Truth, read_truth
from aomgen.conventions import MOVING
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.joint_log import JointLog
from aomgen.io.arrays import npz_bytes, read_npz
from aomgen.io.atomic import staged_folder, write_bytes, write_json
from aomgen.io.jsonfile import read_json
from aomgen.io.video import encode_video, read_video
from aomgen.motion.demonstration import Demonstration as MotionInput
from aomgen.physics.robot import RobotModel, load_robot
from aomgen.splatting.rasterizer import render
from aomgen.synthetic.conditions import Conditions, draw_conditions
from aomgen.synthetic.film import GRIPPER_NOISE, JOINT_NOISE_RAD, LEAD_S, LOG_RATE_HZ, TAIL_S
from aomgen.synthetic.performance import Performance, perform
from aomgen.synthetic.pictures import Painter, exposed
from aomgen.synthetic.setting import build_world
from aomgen.synthetic.timing import CONTROL_STEP_S
from aomgen.synthetic.viewpoints import demo_candidates, scan_cameras
from aomgen.synthetic.world import DEFAULT_ROBOT
from aomgen.synthetic.write import moved_range

CAMERA: Final = "front"
SCAN_VIEWS: Final = 30
_WORLD, _VIDEO, _ARRAYS = "world.json", "demo.mp4", "arrays.npz"
_GAUSSIANS = ("means", "quats", "scales", "opacities", "sh")


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionWorld:
    """What AOMotion is given, and what it should find.

    Attributes:
        name: For example "microwave-2003".
        demonstration: Its input.
        truth: The answers; `scan` is empty.
    """

    name: str
    demonstration: MotionInput
    truth: Truth


def motion_world(category: str, seed: int, folder: Path, upstream: Upstream | None = None) -> MotionWorld:
    """Load a world, made first when it is not there.

    Args:
        category: One of `assets.make.MAKERS`.
        seed: Chooses everything else.
        folder: Where worlds are kept; this one in "<category>-<seed>".
        upstream: Errors of scene, labels, camera and clock.

    Raises:
        ConfigError: Unknown category, or no setting of this seed can be reached.
        BackendError: No OpenGL driver works.
        StorageError: The disk refuses.
    """
    place = folder / f"{category}-{seed}"
    if not (place / _WORLD).is_file():
        _make(category, seed, place, upstream or Upstream())
    return load_motion_world(place)


def _make(category: str, seed: int, place: Path, upstream: Upstream) -> None:
    rng = np.random.default_rng([seed, *category.encode(), 2])
    robot = load_robot(DEFAULT_ROBOT)
    performance = perform(robot, make_asset(category, seed), rng)
    film = _film(robot, performance, draw_conditions(rng), rng)
    middle = performance.setting.T_world_object[:3, 3]
    labels = mislabelled(film.surface.points, film.surface.labels, upstream, rng)
    off = draw_misplacement(upstream, film.demo_camera, middle, rng)
    gaussians = raw_gaussians(film.surface, middle, upstream, rng)
    gaussians = learned(gaussians, film.scan_cameras, film.scan_images, rng)
    with staged_folder(place) as staging:
        write_bytes(staging / _VIDEO, encode_video(film.frames, film.fps, crf=17))
        scene = given_scene(gaussians, off)
        arrays: dict[str, NDArray] = {name: getattr(scene, name) for name in _GAUSSIANS}
        arrays |= {"labels": labels, "labels_true": film.surface.labels}
        arrays |= {name: getattr(film.log, name) for name in ("times_s", "joints", "gripper")}
        write_bytes(staging / _ARRAYS, npz_bytes(arrays))
        answers = _answers(performance, film) | {"S_given_world": off.S_given_world}
        write_json(staging / "truth" / "truth.json", answers)
        write_json(
            staging / _WORLD,
            {
                "category": category,
                "seed": seed,
                "intrinsics": _intrinsics(film.demo_camera),
                "T_world_cam": off.camera.T_world_cam,
                "clock_offset_s": film.clock_offset_s + off.clock_s,
                "clock_sd_s": 1e-3 * upstream.clock_sd_ms,
            },
        )


def load_motion_world(place: Path) -> MotionWorld:
    """Load a world's folder.

    Raises:
        MissingFileError, MalformedFileError: It is not complete.
    """
    content, arrays = read_json(place / _WORLD), read_npz(place / _ARRAYS)
    fx, fy, cx, cy, width, height = content["intrinsics"]
    robot = load_robot(DEFAULT_ROBOT)
    return MotionWorld(
        name=place.name,
        demonstration=MotionInput(
            video=read_video(place / _VIDEO),
            camera=Camera(
                fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height,
                T_world_cam=np.array(content["T_world_cam"]),
            ),
            log=JointLog(
                times_s=arrays["times_s"],
                joints=arrays["joints"],
                gripper=arrays["gripper"],
                joint_names=robot.joint_names,
            ),
            robot=robot,
            scene=Gaussians(**{name: arrays[name] for name in _GAUSSIANS}),
            labels=arrays["labels"],
            clock_offset_s=content["clock_offset_s"],
            clock_sd_s=content["clock_sd_s"],
        ),
        truth=read_truth(place),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _Film:
    """Everything recorded of one performance, exact but for the sensors' noise."""

    demo_camera: Camera
    frames: list[NDArray[np.uint8]]
    steps: NDArray[np.int64]
    fps: int
    log: JointLog
    clock_offset_s: float
    scan_cameras: list[Camera]
    scan_images: list[NDArray[np.uint8]]
    surface: Surface


def _film(
    robot: RobotModel, performance: Performance, conditions: Conditions, rng: np.random.Generator
) -> _Film:
    demonstration, setting = performance.demonstration, performance.setting
    start = rng.uniform(*LEAD_S)
    end = demonstration.times_s[-1] - rng.uniform(*TAIL_S)
    frame_times = start + np.arange(int((end - start) * conditions.fps)) / conditions.fps
    steps = np.round(frame_times / CONTROL_STEP_S).astype(np.int64)
    clock_shift = rng.uniform(0.0, 2.0)
    walk = scan_cameras(setting, conditions, rng)
    walk = [walk[k] for k in np.linspace(0, len(walk) - 1, SCAN_VIEWS).astype(int)]
    world = build_world(robot, setting, visual=True)
    with Painter(robot, world, *conditions.size) as painter:
        camera = _best_camera(painter, demo_candidates(setting, conditions, rng), demonstration.qpos[steps])
        middle = setting.T_world_object[:3, 3]
        surface, images = seen_surface(painter, walk, demonstration.qpos[0], middle, rng)
        images = [exposed(image, 1.0, conditions.noise, rng) for image in images]
        frames = [
            exposed(painter.draw(camera, demonstration.qpos[step]), 1.0, conditions.noise, rng)
            for step in steps
        ]
    return _Film(
        demo_camera=camera,
        frames=frames,
        steps=steps,
        fps=conditions.fps,
        log=_log(robot, performance, clock_shift, rng),
        clock_offset_s=float(start + clock_shift),
        scan_cameras=walk,
        scan_images=images,
        surface=surface,
    )


def _log(
    robot: RobotModel, performance: Performance, clock_shift: float, rng: np.random.Generator
) -> JointLog:
    demonstration = performance.demonstration
    every = round(1.0 / (LOG_RATE_HZ * CONTROL_STEP_S))
    joints, gripper = demonstration.joints[::every], demonstration.gripper[::every]
    return JointLog(
        times_s=demonstration.times_s[::every] + clock_shift,
        joints=joints + JOINT_NOISE_RAD * rng.standard_normal(joints.shape),
        gripper=np.clip(gripper + GRIPPER_NOISE * rng.standard_normal(len(gripper)), 0.0, 1.0),
        joint_names=robot.joint_names,
    )


def _best_camera(painter: Painter, candidates: list[Camera], qpos: NDArray[np.float64]) -> Camera:
    """The candidate that sees most of the moving part, at its worst moment of three."""
    moments = qpos[np.linspace(0, len(qpos) - 1, 3).astype(int)]
    seen = [
        min(int((painter.labels(camera, moment) == MOVING).sum()) for moment in moments)
        for camera in candidates
    ]
    return candidates[int(np.argmax(seen))]


def _answers(performance: Performance, film: _Film) -> dict[str, Any]:
    """Content of truth.json, as `synthetic.write` gives it for captures."""
    joint, demonstration = performance.setting.joint_world, performance.demonstration
    theta = demonstration.theta[film.steps]
    start, end = moved_range(theta, joint)
    contacts = [
        [
            {"finger": touch.finger, "point": touch.point, "normal": touch.normal, "force": touch.force}
            for touch in demonstration.contacts[step]
        ]
        for step in film.steps
    ]
    return {
        "scan": {},
        "demo_cameras": {CAMERA: film.demo_camera.T_world_cam},
        "joint": {"type": joint.type, "axis": joint.axis, "origin": joint.origin, "lower": joint.lower, "upper": joint.upper},
        "theta": {CAMERA: theta},
        "start_frame": start,
        "end_frame": end,
        "clock_offset_s": film.clock_offset_s,
        "qpos": demonstration.joints[film.steps],
        "gripper": demonstration.gripper[film.steps],
        "contacts": contacts,
        "T_world_object": performance.setting.T_world_object,
    }  # fmt: skip


def _intrinsics(camera: Camera) -> list[float]:
    return [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]


def picture(world: MotionWorld) -> NDArray[np.uint8]:
    """First frame beside the scene drawn from the same camera (H, 2 W, 3), for looking at."""
    demonstration = world.demonstration
    drawn = render(demonstration.scene, demonstration.camera).rgb
    drawn = np.clip(np.asarray(drawn) * 255, 0, 255).astype(np.uint8)
    return np.concatenate([demonstration.video.frames_srgb[0], drawn], 1)
