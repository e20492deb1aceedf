"""A performance as it is recorded: stills of the scene, the fixed camera's video, a joint log with its own clock."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING
from aomgen.core.camera import Camera, look_at
from aomgen.core.progress import Progress, silent
from aomgen.core.recording import JointLog
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import Scene
from aomgen.simulation.scene_renderer import SceneRenderer
from synthetic.commanded_trajectory import CONTROL_STEP_S
from synthetic.demonstration_search import Performance, SimulatedDemonstration
from synthetic.layout import SceneLayout, build_world

# Rows of the joint log, [1/s]; a common rate of robot loggers.
LOG_RATE_HZ = 100
# Standard deviation of a logged joint, [rad]: some steps of an encoder; and of the logged gripper, share of its stroke.
JOINT_NOISE_RAD, GRIPPER_NOISE = 0.0005, 0.001
# Shares of the rest phases at both ends that only the log has seen, [s].
LEAD_S, TAIL_S = (0.2, 0.6), (0.1, 0.3)
# A state this near to the last one looks the same, [rad] or [m]: 0.01 px at arm's length.
SAME_STATE = 3e-5
# Spread of read-out noise, and of photon noise at full exposure, 0..255.
READ_NOISE, PHOTON_NOISE = 0.9, 1.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """Cameras and their errors.

    Attributes:
        size: Width and height of stills and video, [px].
        scan_views: Number of stills.
        fps: Frame rate of the video.
        focal_share: Focal length over image width; a phone's main camera has about 0.94.
        noise: Sensor noise, 1 = a phone in a bright room.
        gain_spread: Largest relative change of exposure between stills.
    """

    size: tuple[int, int] = (320, 240)
    scan_views: int = 40
    fps: int = 10
    focal_share: float = 0.9375
    noise: float = 1.0
    gain_spread: float = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSchedule:
    """Times of the camera, and the robot's noisy log with a separate clock.

    Attributes:
        steps: Simulation step of each frame.
        clock_offset_s: Log time = video time + offset.
    """

    steps: NDArray[np.int64]
    log: JointLog
    clock_offset_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedVideo:
    """Recording of the fixed camera: frames (H, W, 3), and the part labels (H, W) of each."""

    schedule: RecordingSchedule
    camera: Camera
    frames: list[NDArray[np.uint8]]
    labels: list[NDArray[np.uint8]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """Everything a synthetic capture holds; cameras, images (H, W, 3) and labels (H, W) have one entry a still."""

    performance: Performance
    scan_cameras: list[Camera]
    scan_images: list[NDArray[np.uint8]]
    scan_labels: list[NDArray[np.uint8]]
    video: RecordedVideo
    conditions: Conditions


def record(
    robot: RobotModel,
    performance: Performance,
    conditions: Conditions,
    rng: np.random.Generator,
    *,
    renderer: Callable[[Scene, tuple[int, int]], SceneRenderer],
    progress: Progress = silent,
) -> Recording:
    """Record a performance: stills of the scene at rest, then the video, as a renderer draws them."""
    demonstration, layout = performance.demonstration, performance.layout
    schedule = draw_schedule(robot, performance, conditions, rng)
    cameras = scan_cameras(layout, conditions, rng)
    world = build_world(robot, layout, visual=True)
    with renderer(world, conditions.size) as painter:
        candidates = demo_candidates(layout, conditions, rng)
        camera = choose_camera(painter, candidates, demonstration, schedule)
        images, labels = [], []
        for number, view in enumerate(cameras):
            gain = 1 + rng.uniform(-conditions.gain_spread, conditions.gain_spread)
            images.append(expose(painter.draw(view, demonstration.qpos[0]), gain, conditions.noise, rng))
            labels.append(painter.labels(view, demonstration.qpos[0]))
            progress(0.05 + 0.35 * number / len(cameras), "stills")
        frames, frame_labels = render_frames(
            painter, camera, demonstration, schedule, conditions, rng,
            progress=lambda share, what: progress(0.4 + 0.6 * share, what),
        )  # fmt: skip
    return Recording(
        performance=performance,
        scan_cameras=cameras,
        scan_images=images,
        scan_labels=labels,
        video=RecordedVideo(schedule=schedule, camera=camera, frames=frames, labels=frame_labels),
        conditions=conditions,
    )


def draw_schedule(
    robot: RobotModel, performance: Performance, conditions: Conditions, rng: np.random.Generator
) -> RecordingSchedule:
    """Cut the video out of the demonstration and write the log by another clock."""
    demonstration, (begin, end) = performance.demonstration, performance.script.film_s
    start = max(begin + rng.uniform(*LEAD_S), 0.0)
    frames = int((end - rng.uniform(*TAIL_S) - start) * conditions.fps)
    frame_times = start + np.arange(frames) / conditions.fps
    clock_shift = rng.uniform(0.0, 2.0)
    every = round(1.0 / (LOG_RATE_HZ * CONTROL_STEP_S))
    joints: Array = demonstration.joints[::every]
    gripper = demonstration.gripper[::every] + GRIPPER_NOISE * rng.standard_normal(len(joints))
    log = JointLog(
        times_s=demonstration.times_s[::every] + clock_shift,
        joints=joints + JOINT_NOISE_RAD * rng.standard_normal(joints.shape),
        gripper=np.clip(gripper, 0.0, 1.0),
        joint_names=robot.joint_names,
    )
    steps = np.round(frame_times / CONTROL_STEP_S).astype(np.int64)
    return RecordingSchedule(steps=steps, log=log, clock_offset_s=float(start + clock_shift))


def scan_cameras(layout: SceneLayout, conditions: Conditions, rng: np.random.Generator) -> list[Camera]:
    """A hand-held walk in three arcs around robot and object, low to high."""
    x, y = _object_place(layout)
    target = np.array([0.6 * x, 0.58 * y, layout.room.table_z + 0.12])
    arcs = np.array_split(np.arange(conditions.scan_views), 3)
    cameras = []
    for number, arc in enumerate(arcs):
        sweep = np.linspace(-1.0, 1.0, len(arc)) * (1 if number % 2 == 0 else -1)
        for share in sweep:
            angle = np.deg2rad(98.0 * share + rng.uniform(-3, 3))
            radius = (1.22, 1.18, 1.05)[number] + rng.uniform(-0.06, 0.06)
            height = layout.room.table_z + (0.32, 0.58, 0.95)[number] + rng.uniform(-0.05, 0.05)
            eye = np.array([target[0] + radius * np.sin(angle), target[1] - radius * np.cos(angle), height])
            aim = target + rng.uniform(-0.07, 0.07, 3)
            cameras.append(_in_room(layout, conditions, eye, aim))
    return cameras


def demo_candidates(layout: SceneLayout, conditions: Conditions, rng: np.random.Generator) -> list[Camera]:
    """Places for the fixed camera, left and right of the robot, all see the front of the object."""
    x, y = _object_place(layout)
    target = np.array([0.8 * x, 0.68 * y, layout.room.table_z + 0.13])
    cameras = []
    for side in (-1.0, 1.0, -1.0, 1.0):
        height = layout.room.table_z + rng.uniform(0.5, 0.8)
        eye = np.array([target[0] + side * rng.uniform(0.85, 1.15), rng.uniform(-0.4, 0.0), height])
        cameras.append(_in_room(layout, conditions, eye, target + rng.uniform(-0.04, 0.04, 3)))
    return cameras


def _object_place(layout: SceneLayout) -> tuple[float, float]:
    """Middle of the object on the table (x, y), room frame, [m]."""
    place = apply(invert(layout.room.T_world_room), layout.T_world_object[:3, 3])
    return float(place[0]), float(place[1])


def _in_room(layout: SceneLayout, conditions: Conditions, eye_room: Array, target_room: Array) -> Camera:
    T, (width, height) = layout.room.T_world_room, conditions.size
    focal = conditions.focal_share * width
    T_world_cam = look_at(apply(T, eye_room), apply(T, target_room))
    return Camera(
        fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height, T_world_cam=T_world_cam
    )


def choose_camera(
    painter: SceneRenderer,
    candidates: list[Camera],
    demonstration: SimulatedDemonstration,
    schedule: RecordingSchedule,
) -> Camera:
    """The candidate that sees most of the moving part, at its worst moment of three."""
    moments = schedule.steps[np.linspace(0, len(schedule.steps) - 1, 3).astype(int)]
    seen = [
        min(int((painter.labels(camera, demonstration.qpos[step]) == MOVING).sum()) for step in moments)
        for camera in candidates
    ]
    return candidates[int(np.argmax(seen))]


def render_frames(
    painter: SceneRenderer,
    camera: Camera,
    demonstration: SimulatedDemonstration,
    schedule: RecordingSchedule,
    conditions: Conditions,
    rng: np.random.Generator,
    *,
    progress: Progress = silent,
) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]]:
    """Frames and part labels of a video; a scene at rest is drawn once, its noise is new each time."""
    frames, labels = [], []
    painted: Array | None = None
    for number, step in enumerate(schedule.steps):
        state = demonstration.qpos[step]
        if painted is None or np.abs(state - painted).max() > SAME_STATE:
            painted = state
            clean, marked = painter.draw(camera, state), painter.labels(camera, state)
        frames.append(expose(clean, 1.0, conditions.noise, rng))
        labels.append(marked)
        progress(number / len(schedule.steps), "video")
    return frames, labels


def expose(
    picture: NDArray[np.uint8], gain: float, noise: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The image (H, W, 3) as a sensor records it: exposure gain, photon and read-out noise."""
    signal = picture.astype(np.float64) * gain
    spread = noise * np.sqrt(READ_NOISE**2 + PHOTON_NOISE**2 * signal / 255.0)
    noisy = signal + spread * rng.standard_normal(picture.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)
