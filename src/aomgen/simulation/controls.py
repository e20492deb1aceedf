"""Controls of arm and gripper at every control tick of a commanded motion."""

import math
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from aomgen.core.values import Array
from aomgen.simulation.scene import Scene

# Rate of a UR5e's controller, [1/s]; a frame lasts a whole number of control ticks, so the rate used is a little higher.
CONTROL_HZ: Final = 125.0
# The arm rests at its first configuration for this long before the episode begins.
SETTLE_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class Commands:
    """Commands at every control tick (N): joints and their velocities (N, J), gripper (N,), 0..1."""

    joints: Array
    velocities: Array
    gripper: Array


def divide_frame(fps: float, longest_step_s: float) -> tuple[int, int, float]:
    """Divide a frame into control ticks and these into equal steps: ticks a frame, steps a tick, length of a step [s]."""
    ticks = math.ceil(CONTROL_HZ / fps)
    steps = math.ceil(1 / (fps * ticks * longest_step_s))
    return ticks, steps, 1 / (fps * ticks * steps)


def ramp(start: Array, target: Array, fps: float, ticks: int) -> Commands:
    """Commands at the ticks of one frame straight from joints and gripper (J + 1,) to others, which the next begins with."""
    step = target - start
    samples = start + (np.arange(ticks) / ticks)[:, None] * step
    return Commands(samples[:, :-1], np.tile(fps * step[:-1], (ticks, 1)), samples[:, -1])


def servo_controls(scene: Scene, commands: Commands) -> Array:
    """Actuator controls (N, nu) of commands (N)."""
    arm, (opened, closed) = scene.arm, scene.gripper.control_range
    controls = np.zeros((len(commands.joints), scene.model.nu))
    controls[:, arm.actuators] = commands.joints + arm.kv / arm.kp * commands.velocities
    controls[:, scene.gripper.actuator] = opened + commands.gripper * (closed - opened)
    return controls


def ignore_hand_on_hand(scene: Scene, model: mujoco.MjModel) -> None:
    """Leave out contacts between shapes of the gripper other than its pads.

    Where the shapes of a gripper's links are meshes, looking for contacts among them takes a sixth of all time.
    """
    shell = scene.roles.gripper & (scene.roles.finger < 0)
    model.geom_contype[shell] |= model.geom_conaffinity[shell]
    model.geom_conaffinity[shell] = 0
