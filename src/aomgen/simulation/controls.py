"""Compute the controls of arm and gripper at every control tick of a commanded motion."""

import math
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from aomgen.core.values import Array
from aomgen.simulation.scene import Scene

# Smallest control rate, [Hz]. A frame has an integer number of control ticks, so the actual rate can be slightly higher.
CONTROL_HZ: Final = 125.0
# Time for which the arm holds its first configuration before the episode begins, [s].
SETTLE_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class Commands:
    """Commands at N control ticks: joints and their velocities (N, J), gripper (N,), 0 open .. 1 closed."""

    joints: Array
    velocities: Array
    gripper: Array


def divide_frame(fps: float, longest_step_s: float) -> tuple[int, int, float]:
    """Divide a frame into control ticks, and these into equal simulation steps.

    Args:
        fps: Frames per second.
        longest_step_s: Largest accepted step, [s].

    Returns:
        Ticks per frame, steps per tick, and length of a step, [s].
    """
    ticks = math.ceil(CONTROL_HZ / fps)
    steps = math.ceil(1 / (fps * ticks * longest_step_s))
    return ticks, steps, 1 / (fps * ticks * steps)


def ramp(start: Array, target: Array, fps: float, ticks: int) -> Commands:
    """Compute the commands at the ticks of one frame by linear interpolation.

    Args:
        start: Joints and gripper (J + 1,) at the first tick.
        target: Joints and gripper (J + 1,) at the first tick of the next frame.
        fps: Frames per second.
        ticks: Ticks per frame.
    """
    step = target - start
    samples = start + (np.arange(ticks) / ticks)[:, None] * step
    return Commands(samples[:, :-1], np.tile(fps * step[:-1], (ticks, 1)), samples[:, -1])


def servo_controls(scene: Scene, commands: Commands) -> Array:
    """Compute the actuator controls (N, nu) for commands at N ticks."""
    arm, (opened, closed) = scene.arm, scene.gripper.control_range
    grip = scene.model.actuator(scene.gripper.actuator).id
    controls = np.zeros((len(commands.joints), scene.model.nu))
    controls[:, arm.actuators] = commands.joints + arm.kv / arm.kp * commands.velocities
    controls[:, grip] = opened + commands.gripper * (closed - opened)
    return controls


def ignore_hand_on_hand(scene: Scene, model: mujoco.MjModel) -> None:
    """Disable contacts between geoms of the gripper other than its pads, in `model`.

    If these geoms are meshes, the detection of contacts between them takes a sixth of the computing time.
    """
    shell = scene.roles.gripper & (scene.roles.finger < 0)
    model.geom_contype[shell] |= model.geom_conaffinity[shell]
    model.geom_conaffinity[shell] = 0
