"""The fixed camera's video of a performance: when it runs, from where, what it shows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING
from aomgen.core.camera import Camera
from aomgen.core.joint_log import JointLog
from aomgen.core.progress import Progress, silent
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.synthetic.commanded_trajectory import CONTROL_STEP_S
from aomgen.synthetic.conditions import Conditions
from aomgen.synthetic.demonstration_search import Performance, SimulatedDemonstration
from aomgen.synthetic.scene_renderer import SceneRenderer, expose

# Rows of the joint log, [1/s]; a common rate of robot loggers.
LOG_RATE_HZ = 100
# Noise of a logged joint, standard deviation, [rad]: some steps of an encoder.
JOINT_NOISE_RAD = 0.0005
# Noise of the logged gripper opening, standard deviation, as a share of its stroke.
GRIPPER_NOISE = 0.001
# Shares of the rest phases at both ends that only the log has seen, [s].
LEAD_S, TAIL_S = (0.2, 0.6), (0.1, 0.3)
# A state this near to the last one looks the same, [rad] or [m]: 0.01 px at arm's length.
SAME_STATE = 3e-5


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSchedule:
    """When the camera runs, and the robot's noisy log with a clock of its own.

    Attributes:
        steps: Simulation step of each frame.
        clock_offset_s: Log time = video time + offset.
    """

    steps: NDArray[np.int64]
    log: JointLog
    clock_offset_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedVideo:
    """What the fixed camera recorded: frames (H, W, 3), and the part labels (H, W) of each."""

    schedule: RecordingSchedule
    camera: Camera
    frames: list[NDArray[np.uint8]]
    labels: list[NDArray[np.uint8]]


def draw_schedule(
    robot: RobotModel, performance: Performance, conditions: Conditions, rng: np.random.Generator
) -> RecordingSchedule:
    """Cut the video out of the demonstration and write the log by another clock."""
    begin, end = performance.script.film_s
    start = max(begin + rng.uniform(*LEAD_S), 0.0)
    frames = int((end - rng.uniform(*TAIL_S) - start) * conditions.fps)
    frame_times = start + np.arange(frames) / conditions.fps
    clock_shift = rng.uniform(0.0, 2.0)
    return RecordingSchedule(
        steps=np.round(frame_times / CONTROL_STEP_S).astype(np.int64),
        log=_log(robot, performance.demonstration, clock_shift, rng),
        clock_offset_s=float(start + clock_shift),
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
    """Frames and part labels of a take; a scene at rest is drawn once, its noise is new each time."""
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


def _log(
    robot: RobotModel, demonstration: SimulatedDemonstration, clock_shift: float, rng: np.random.Generator
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
