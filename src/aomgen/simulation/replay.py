"""Run a commanded trajectory in MuJoCo: the object's joint is passive, only contact moves it."""

import copy
import math
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.core.transforms import transform
from aomgen.core.values import Array
from aomgen.core.verdict import Rejection
from aomgen.simulation.scene import Scene

# Rate of a UR5e's controller, [1/s]; a frame lasts a whole number of control ticks, so the rate used is a little higher.
CONTROL_HZ: Final = 125.0
# The arm stands at its first configuration for this long before the episode begins.
SETTLE_S: Final = 0.2
DIVERGENCE = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_BADCTRL,
    mujoco.mjtWarning.mjWARN_INERTIA,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PadContact:
    """One contact of a finger pad with the moving part.

    Attributes:
        tick: Control tick.
        finger: 0 left, 1 right.
        point_world: (3,), [m].
        normal_world: Unit, from the object into the finger (3,).
        force: Normal force, [N].
    """

    tick: int
    finger: int
    point_world: Array
    normal_world: Array
    force: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedRun:
    """What happened, once a control tick (N ticks).

    Attributes:
        frame_ticks: Tick of each commanded sample (T,).
        joints: Reached arm joints (N, J), [rad].
        gripper: Reached gripper (N,), 0..1.
        thetas: Object joint (N,), [rad] or [m].
        Ts_world_ee: Reached end effector (N, 4, 4).
        commands: Commanded arm joints (N, J), [rad].
        pad_forces: Sum of the pads' normal forces on the moving part (N,), [N].
        reactions: Level force of the whole robot on the object (N,), [N].
        drift_m: How far the object's base moved (N,), [m].
        touches: Pad contacts.
    """

    frame_ticks: NDArray[np.int64]
    joints: Array
    gripper: Array
    thetas: Array
    Ts_world_ee: Array
    commands: Array
    pad_forces: Array
    reactions: Array
    drift_m: Array
    touches: tuple[PadContact, ...]


def simulate(
    scene: Scene, joints: Array, gripper: Array, fps: float, *, initial_theta: float = 0.0
) -> SimulatedRun | Rejection:
    """Track a trajectory with the arm's position controllers, without looking ahead.

    From sample t on, the command moves straight from sample t to sample t + 1 at constant velocity:
    the exported action at t, which names the target at t + 1, and the one before it are all that is used.
    Velocity feed-forward, `ctrl = q + kv / kp * dq`, takes the lag out of a position actuator.
    The object's joint is written once, at reset. Autoreset is off (see `build_scene`) and a
    warning of divergence ends the run.

    Args:
        scene: Object placed, resistance set.
        joints: Commanded arm joints (T, J), [rad], T >= 2.
        gripper: Commanded gripper (T,), 0..1.
        fps: Samples a second of both.
        initial_theta: Object joint at reset; anything but 0 is for tests.

    Returns:
        The run; or a Rejection "diverged".
    """
    ticks_a_frame = math.ceil(CONTROL_HZ / fps)
    steps_a_tick = math.ceil(1 / (fps * ticks_a_frame * scene.model.opt.timestep))
    model = copy.copy(scene.model)
    model.opt.timestep = 1 / (fps * ticks_a_frame * steps_a_tick)
    data = mujoco.MjData(model)
    data.qpos[:] = scene.qpos(joints[:1], gripper[0], initial_theta)[0]
    commands, velocities, closing = linear_commands(joints, gripper, fps, ticks_a_frame)
    data.ctrl[:] = servo_control(scene, joints[0], np.zeros_like(joints[0]), gripper[0])
    start_base = _base_position(scene, data)
    mujoco.mj_step(model, data, round(SETTLE_S / model.opt.timestep))
    log = _Log(scene=scene, count=len(commands), start_base=start_base)
    for tick, command in enumerate(commands):
        log.record(tick, data)
        data.ctrl[:] = servo_control(scene, command, velocities[tick], closing[tick])
        mujoco.mj_step(model, data, steps_a_tick)
        if any(data.warning[kind].number for kind in DIVERGENCE):
            time_s = tick / (fps * ticks_a_frame)
            return Rejection(
                reason="diverged",
                detail=f"the simulation became unstable at {time_s:.2f} s",
                metrics={"time_s": time_s},
            )
    return log.finished(ticks_a_frame * np.arange(len(joints)), commands)


def linear_commands(
    joints: Array, gripper: Array, fps: float, ticks_a_frame: int
) -> tuple[Array, Array, Array]:
    """Command at every control tick, straight from each sample to the next.

    Args:
        joints: Samples (T, J), [rad].
        gripper: Samples (T,), 0..1.
        fps: Samples a second.
        ticks_a_frame: Control ticks from one sample to the next.

    Returns:
        Joints (N, J), [rad], their velocities (N, J), [rad/s], and gripper (N,), with
        N = (T - 1) * ticks_a_frame + 1; at the last tick the arm is commanded to stand.
    """
    samples = np.column_stack([joints, gripper])
    steps = np.diff(samples, axis=0)
    shares = np.arange(ticks_a_frame) / ticks_a_frame
    moving = samples[:-1, None] + shares[:, None] * steps[:, None]
    commands = np.concatenate([moving.reshape(-1, samples.shape[1]), samples[-1:]])
    velocities = np.concatenate([np.repeat(fps * steps, ticks_a_frame, 0), np.zeros((1, steps.shape[1]))])
    return commands[:, :-1], velocities[:, :-1], commands[:, -1]


def servo_control(scene: Scene, command: Array, velocity: Array, closing: float) -> Array:
    """Actuator controls (nu,) for arm joints (J,), [rad], their velocities [rad/s], and gripper 0..1."""
    arm = scene.arm
    control = np.zeros(scene.model.nu)
    control[arm.actuators] = command + arm.kv / arm.kp * velocity
    opened, closed = scene.gripper.control_range
    control[scene.gripper.actuator] = opened + closing * (closed - opened)
    return control


def _base_position(scene: Scene, data: mujoco.MjData) -> Array:
    mujoco.mj_kinematics(scene.model, data)
    return data.xpos[scene.model.body(scene.names.static_body).id].copy()


class _Log:
    """Collects one row a tick; a builder, gone when the run is finished."""

    def __init__(self, *, scene: Scene, count: int, start_base: Array) -> None:
        self.scene = scene
        self.start_base = start_base
        self.base = scene.model.body(scene.names.static_body).id
        self.joints = np.zeros((count, len(scene.arm.qpos)))
        self.gripper, self.thetas = np.zeros(count), np.zeros(count)
        self.pad_forces, self.reactions, self.drift = np.zeros(count), np.zeros(count), np.zeros(count)
        self.Ts_world_ee = np.zeros((count, 4, 4))
        self.touches: list[PadContact] = []

    def record(self, tick: int, data: mujoco.MjData) -> None:
        scene = self.scene
        self.joints[tick] = data.qpos[scene.arm.qpos]
        opened, closed = scene.gripper.driver_range
        self.gripper[tick] = (data.qpos[scene.gripper.driver] - opened) / (closed - opened)
        self.thetas[tick] = data.qpos[scene.object_qpos]
        site = scene.ee_site
        self.Ts_world_ee[tick] = transform(data.site_xmat[site].reshape(3, 3), data.site_xpos[site])
        self.drift[tick] = np.linalg.norm(data.xpos[self.base] - self.start_base)
        self._contacts(tick, data)

    def _contacts(self, tick: int, data: mujoco.MjData) -> None:
        roles = self.scene.roles
        total = np.zeros(3)
        wrench = np.zeros(6)
        for index in range(data.ncon):
            contact = data.contact[index]
            a, b = int(contact.geom[0]), int(contact.geom[1])
            # MuJoCo's normal points from the first geom to the second; ours from object to robot.
            sign = 1.0
            if roles.robot[a]:
                a, b, sign = b, a, -1.0
            if not (roles.robot[b] and (roles.moving[a] or roles.static[a])):
                continue
            mujoco.mj_contactForce(self.scene.model, data, index, wrench)
            frame = contact.frame.reshape(3, 3)
            total += sign * (frame.T @ wrench[:3])
            finger = int(roles.finger[b])
            if finger >= 0 and roles.moving[a] and wrench[0] > 0:
                self.pad_forces[tick] += wrench[0]
                self.touches.append(
                    PadContact(
                        tick=tick,
                        finger=finger,
                        point_world=contact.pos.copy(),
                        normal_world=sign * frame[0],
                        force=float(wrench[0]),
                    )
                )
        self.reactions[tick] = float(np.linalg.norm(total[:2]))

    def finished(self, frame_ticks: NDArray[np.int64], commands: Array) -> SimulatedRun:
        return SimulatedRun(
            frame_ticks=frame_ticks,
            joints=self.joints,
            gripper=np.clip(self.gripper, 0, 1),
            thetas=self.thetas,
            Ts_world_ee=self.Ts_world_ee,
            commands=commands,
            pad_forces=self.pad_forces,
            reactions=self.reactions,
            drift_m=self.drift,
            touches=tuple(self.touches),
        )
