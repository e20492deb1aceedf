"""Cheap worlds for AOMotion alone: a demonstration video, and upstream results with realistic errors.

The demonstration is simulated (the object moves by contact alone) and rendered as captures are; scene,
labels, camera and clock are true ones perturbed by `motion_upstream.Upstream`.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from aomgen.core.alignment import Clock
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.recording import JointLog
from aomgen.errors import ConfigError
from aomgen.io.artifact import npz_bytes, read_json, read_npz
from aomgen.io.atomic import stage_folder, write_bytes, write_json
from aomgen.io.video import encode_video, read_video
from aomgen.motion.inputs import MotionInput as MotionInput
from aomgen.robots.loading import load_robot
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene_renderer import SceneRenderer
from aomgen.splatting.rasterizer import render
from benchmarks.motion_scan import Surface, learned, raw_gaussians, seen_surface
from benchmarks.motion_upstream import Upstream, draw_misplacement, mislabelled
from benchmarks.other_objects import make_object
from benchmarks.synthetic_captures import draw_conditions
from benchmarks.truth import Truth, read_truth
from synthetic.demonstration_search import Performance, find_demonstration
from synthetic.grasp_selection import list_grasp_types
from synthetic.layout import build_world
from synthetic.scene_recording import (
    Conditions,
    RecordedVideo,
    choose_camera,
    demo_candidates,
    draw_schedule,
    expose,
    render_frames,
    scan_cameras,
)
from synthetic.style import DemonstrationStyle, draw_style
from synthetic.world import DEFAULT_ROBOT, find_moved_range

Kind = Literal["open", "closing", "hook", "push", "nothing", "touch", "locked", "cut", "short"]
# Kinds whose joint cannot be determined, and the errors that state the reason.
UNSOLVABLE: Final[dict[Kind, tuple[str, ...]]] = {
    "nothing": ("NoMotionError",),
    "touch": ("NoMotionError",),
    "locked": ("NoMotionError", "DemonstrationTooShortError"),
    "cut": ("NoMotionError",),
    "short": ("DemonstrationTooShortError", "AmbiguousJointError"),
}
# Travel that is too short to determine a joint, [rad] or [m].
SHORT: Final = {"revolute": float(np.deg2rad(5.0)), "prismatic": 0.01}
MAX_MANNERS: Final = 6
CAMERA: Final = "front"
SCAN_VIEWS: Final = 30
# Next to truth.json: labels of the Gaussians, and of every frame of the video.
TRUE_ARRAYS: Final = "arrays.npz"
_WORLD, _VIDEO, _ARRAYS = "world.json", "demo.mp4", "arrays.npz"
_GAUSSIANS = ("means", "quats", "scales", "opacities", "sh")


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionWorld:
    """Input of AOMotion, and the true result.

    Attributes:
        name: For example "microwave-2003".
        demonstration: Its input.
        truth: The true values; `scan` is empty.
    """

    name: str
    demonstration: MotionInput
    truth: Truth


def motion_world(category: str, seed: int, folder: Path, kind: Kind = "open") -> MotionWorld:
    """Load a world, which is made first if it does not exist.

    Args:
        category: A category of `other_objects.make_object`.
        seed: Seed of all other choices.
        folder: Folder of all worlds; this one is in "<category>-<seed>", or "<category>-<seed>-<kind>".
        kind: Kind of the demonstration.

    Raises:
        ConfigError: The category is unknown, or no setting of this seed is reachable.
        BackendError: No OpenGL driver works.
        StorageError: A file cannot be written.
    """
    place = folder / (f"{category}-{seed}" + ("" if kind == "open" else f"-{kind}"))
    if not (place / _WORLD).is_file():
        _make(category, seed, kind, place)
    return load_motion_world(place)


def _make(category: str, seed: int, kind: Kind, place: Path) -> None:
    rng, upstream = np.random.default_rng([seed, *category.encode(), *kind.encode()]), Upstream()
    robot = load_robot(DEFAULT_ROBOT)
    performance = performed(robot, category, seed, kind, rng)
    recorded = _recorded(robot, performance, draw_conditions(rng), rng)
    video, surface = recorded.video, recorded.surface
    middle = performance.layout.T_world_object[:3, 3]
    off = draw_misplacement(upstream, video.camera, middle, rng)
    labels = mislabelled(surface.points, surface.labels, upstream, rng)
    gaussians = raw_gaussians(surface, middle, upstream, rng)
    gaussians = learned(gaussians, recorded.scan_cameras, recorded.scan_images, rng)
    scene = gaussians.transform(off.S_given_world)
    arrays: dict[str, NDArray] = {name: getattr(scene, name) for name in _GAUSSIANS} | {"labels": labels}
    arrays |= {name: getattr(video.schedule.log, name) for name in ("times_s", "joints", "gripper")}
    truth: dict[str, NDArray] = {"labels": surface.labels, "film_labels": np.stack(video.labels)}
    answers = _answers(performance, video) | {"S_given_world": off.S_given_world}
    world = {
        "intrinsics": _intrinsics(video.camera),
        "T_world_cam": off.camera.T_world_cam,
        "clock_offset_s": video.schedule.clock_offset_s + off.clock_s,
        "clock_sd_s": 1e-3 * upstream.clock_sd_ms,
    }
    with stage_folder(place) as staging:
        write_bytes(staging / _VIDEO, encode_video(video.frames, recorded.fps, crf=17))
        write_bytes(staging / _ARRAYS, npz_bytes(arrays))
        write_bytes(staging / "truth" / TRUE_ARRAYS, npz_bytes(truth))
        write_json(staging / "truth" / "truth.json", answers)
        write_json(staging / _WORLD, world)


def load_motion_world(place: Path) -> MotionWorld:
    """Load a world's folder.

    Raises:
        MissingFileError, MalformedFileError: The folder is incomplete.
    """
    content, arrays = read_json(place / _WORLD), read_npz(place / _ARRAYS)
    fx, fy, cx, cy, width, height = content["intrinsics"]
    robot = load_robot(DEFAULT_ROBOT)
    clock = Clock(offset_s=content["clock_offset_s"], sd_s=content["clock_sd_s"])
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
            ).shift(clock.offset_s),
            robot=robot,
            scene=Gaussians(**{name: arrays[name] for name in _GAUSSIANS}),
            labels=arrays["labels"],
            clock=clock,
        ),
        truth=read_truth(place),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _Recorded:
    """Recorded data of one performance, exact except for the sensors' noise."""

    video: RecordedVideo
    fps: int
    scan_cameras: list[Camera]
    scan_images: list[NDArray[np.uint8]]
    surface: Surface


def _recorded(
    robot: RobotModel, performance: Performance, conditions: Conditions, rng: np.random.Generator
) -> _Recorded:
    demonstration, layout = performance.demonstration, performance.layout
    schedule = draw_schedule(robot, performance, conditions, rng)
    walk = scan_cameras(layout, conditions, rng)
    walk = [walk[k] for k in np.linspace(0, len(walk) - 1, SCAN_VIEWS).astype(int)]
    world = build_world(robot, layout, visual=True)
    with SceneRenderer(world, conditions.size) as painter:
        camera = choose_camera(painter, demo_candidates(layout, conditions, rng), demonstration, schedule)
        middle = layout.T_world_object[:3, 3]
        surface, images = seen_surface(painter, walk, demonstration.qpos[0], middle, rng)
        frames, labels = render_frames(painter, camera, demonstration, schedule, conditions, rng)
    return _Recorded(
        video=RecordedVideo(schedule=schedule, camera=camera, frames=frames, labels=labels),
        fps=conditions.fps,
        scan_cameras=walk,
        scan_images=[expose(image, 1.0, conditions.noise, rng) for image in images],
        surface=surface,
    )


def performed(
    robot: RobotModel, category: str, seed: int, kind: Kind, rng: np.random.Generator
) -> Performance:
    """Find a demonstration of a kind; styles are drawn until one is feasible.

    Raises:
        ConfigError: None of MAX_MANNERS is feasible.
    """
    asset = make_object(category, seed)
    for _ in range(MAX_MANNERS - 1):
        try:
            return find_demonstration(robot, asset, rng, draw_kind_style(kind, asset, rng))
        except ConfigError:
            continue
    return find_demonstration(robot, asset, rng, draw_kind_style(kind, asset, rng))


def draw_kind_style(kind: Kind, asset: ArticulatedAsset, rng: np.random.Generator) -> DemonstrationStyle:
    """Draw a random style of a kind."""
    if kind == "short":
        style = draw_style(asset, rng)
        return replace(style, travel=SHORT[asset.joint.type], pause_s=0.0, slip_m=0.0, grip=1.0)
    if kind == "closing":
        return draw_style(asset, rng, direction="closing")
    if kind in ("hook", "push"):
        direction = "closing" if kind == "push" else "opening"
        # A lid or a sliding panel cannot be hooked: its handle is pushed along the front.
        touch = kind if kind in list_grasp_types(asset, direction) else "push"
        return draw_style(asset, rng, touch=touch, direction=direction)
    if kind == "open":
        return draw_style(asset, rng)
    return draw_style(asset, rng, outcome=kind)


def _answers(performance: Performance, video: RecordedVideo) -> dict[str, Any]:
    """Make the content of truth.json, as `synthetic.write` does for captures."""
    joint, demonstration, steps = performance.joint, performance.demonstration, video.schedule.steps
    theta = performance.theta[steps]
    start, end = find_moved_range(theta, joint)
    contacts = [
        [
            {"finger": touch.finger, "point": touch.point, "normal": touch.normal, "force": touch.force}
            for touch in demonstration.contacts[step]
        ]
        for step in steps
    ]
    return {
        "scan": {},
        "demo_cameras": {CAMERA: video.camera.T_world_cam},
        "joint": {"type": joint.type, "axis": joint.axis, "origin": joint.origin, "lower": joint.lower, "upper": joint.upper},
        "direction": performance.style.direction,
        "manner": asdict(performance.style),
        "theta": {CAMERA: theta},
        "start_frame": start,
        "end_frame": end,
        "clock_offset_s": video.schedule.clock_offset_s,
        "qpos": demonstration.joints[steps],
        "gripper": demonstration.gripper[steps],
        "contacts": contacts,
        "T_world_object": performance.layout.T_world_object,
    }  # fmt: skip


def _intrinsics(camera: Camera) -> list[float]:
    return [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]


def picture(world: MotionWorld) -> NDArray[np.uint8]:
    """Render the scene next to the first frame from the same camera (H, 2 W, 3), for inspection."""
    demonstration = world.demonstration
    drawn = render(demonstration.scene, demonstration.camera).rgb
    drawn = np.clip(np.asarray(drawn) * 255, 0, 255).astype(np.uint8)
    return np.concatenate([demonstration.video.frames_srgb[0], drawn], 1)
