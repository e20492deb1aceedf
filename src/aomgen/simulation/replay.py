"""The simulator: an arm tracks commands in MuJoCo; the object's joint is passive, only contact moves it."""

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.core.episode import ContactLog
from aomgen.core.plan import Rejection
from aomgen.core.transforms import transform
from aomgen.core.values import Array
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


@dataclass(frozen=True, slots=True)
class Commands:
    """What the arm is told at every control tick (N): joints and their velocities (N, J), gripper (N,), 0..1."""

    joints: Array
    velocities: Array
    gripper: Array


@dataclass(frozen=True, slots=True)
class Touch:
    """One contact of the robot with anything else.

    Attributes:
        robot_geom, other_geom: Of the model.
        distance: Between them, negative where they overlap, [m].
        normal_world: Unit, into the robot.
        force: Normal force, [N].
        force_world: Whole force on the robot, [N].
    """

    robot_geom: int
    other_geom: int
    distance: float
    point_world: Array
    normal_world: Array
    force: float
    force_world: Array


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
        drift_m: How far the object's base moved since the first tick (N,), [m].
        contacts: Of the pads with the moving part; its frames are ticks.
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
    contacts: ContactLog


def simulate(
    scene: Scene, joints: Array, gripper: Array, fps: float, *, initial_theta: float = 0.0
) -> SimulatedRun | Rejection:
    """Track joints (T, J) and gripper (T,), T >= 2, with the arm's position controllers, without looking ahead.

    From sample t on, the command moves straight from sample t to sample t + 1 at constant velocity:
    the exported action at t, which names the target at t + 1, and the one before it are all that is used.
    Autoreset is off (see `build_scene`) and a warning of divergence ends the run with a Rejection "diverged".
    `initial_theta` sets the object's joint at reset; anything but 0 is for tests.
    """
    ticks_a_frame = math.ceil(CONTROL_HZ / fps)
    steps_a_tick = math.ceil(1 / (fps * ticks_a_frame * scene.model.opt.timestep))
    model = copy.copy(scene.model)
    model.opt.timestep = 1 / (fps * ticks_a_frame * steps_a_tick)
    commands = _linear_commands(joints, gripper, fps, ticks_a_frame)
    start = scene.qpos(joints[:1], gripper[0], initial_theta)[0]
    roles, base = scene.roles, model.body(scene.names.static_body).id
    qpos, places, bases, touches = [], [], [], []
    reactions = np.zeros(len(commands.joints))
    for tick, data in enumerate(track(scene, model, start, commands, SETTLE_S, steps_a_tick)):
        if any(data.warning[kind].number for kind in DIVERGENCE):
            time_s = data.time - SETTLE_S
            return Rejection(
                reason="diverged",
                detail=f"the simulation became unstable at {time_s:.2f} s",
                metrics={"time_s": time_s},
            )
        qpos.append(data.qpos.copy())
        places.append(transform(data.site_xmat[scene.ee_site].reshape(3, 3), data.site_xpos[scene.ee_site]))
        bases.append(data.xpos[base].copy())
        on_object = [
            touch
            for touch in read_touches(scene, data)
            if roles.moving[touch.other_geom] or roles.static[touch.other_geom]
        ]
        reactions[tick] = np.linalg.norm(sum((touch.force_world[:2] for touch in on_object), np.zeros(2)))
        touches += [
            (tick, touch)
            for touch in on_object
            if touch.force > 0 and roles.moving[touch.other_geom] and roles.finger[touch.robot_geom] >= 0
        ]
    ticks = np.array([tick for tick, _ in touches], np.int64)
    forces = np.array([touch.force for _, touch in touches])
    reached, (opened, closed) = np.array(qpos), scene.gripper.driver_range
    return SimulatedRun(
        frame_ticks=ticks_a_frame * np.arange(len(joints)),
        joints=reached[:, scene.arm.qpos],
        gripper=np.clip((reached[:, scene.gripper.driver] - opened) / (closed - opened), 0, 1),
        thetas=reached[:, scene.object_qpos],
        Ts_world_ee=np.array(places),
        commands=commands.joints,
        pad_forces=np.bincount(ticks, forces, len(reached)).astype(np.float64),
        reactions=reactions,
        drift_m=np.linalg.norm(np.array(bases) - bases[0], axis=1),
        contacts=ContactLog(
            frames=ticks,
            fingers=roles.finger[[touch.robot_geom for _, touch in touches]],
            points_world=np.array([touch.point_world for _, touch in touches]).reshape(-1, 3),
            normals_world=np.array([touch.normal_world for _, touch in touches]).reshape(-1, 3),
            forces=forces,
        ),
    )


def track(
    scene: Scene,
    model: mujoco.MjModel,
    start: Array,
    commands: Commands,
    settle_s: float,
    steps_a_tick: int = 1,
) -> Iterator[mujoco.MjData]:
    """Drive arm and gripper by position control; gives the state at every tick, before its command is applied.

    Velocity feed-forward, `ctrl = q + kv / kp * dq`, takes the lag out of a position actuator. Nothing is written
    into the state after the start.

    Args:
        scene: What is where in the model.
        model: The scene's, maybe with another time step.
        start: Generalised positions (nq,); the first command is held there before the first tick.
        commands: At every tick.
        settle_s: Time before the first tick, in which servos and contacts come to rest, [s].
        steps_a_tick: Steps of the model from one tick to the next.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = start
    data.ctrl[:] = _servo_control(
        scene, commands.joints[0], np.zeros_like(commands.joints[0]), commands.gripper[0]
    )
    mujoco.mj_step(model, data, round(settle_s / model.opt.timestep))
    for joints, velocity, closing in zip(commands.joints, commands.velocities, commands.gripper, strict=True):
        yield data
        data.ctrl[:] = _servo_control(scene, joints, velocity, closing)
        mujoco.mj_step(model, data, steps_a_tick)


def read_touches(scene: Scene, data: mujoco.MjData) -> Iterator[Touch]:
    """Contacts of the robot with what is not the robot."""
    robot, wrench = scene.roles.robot, np.zeros(6)
    for index in range(data.ncon):
        contact = data.contact[index]
        a, b = (int(geom) for geom in contact.geom)
        if robot[a] == robot[b]:
            continue
        mujoco.mj_contactForce(scene.model, data, index, wrench)
        # MuJoCo's normal points from the first geom to the second; ours into the robot.
        sign, frame = -1.0 if robot[a] else 1.0, contact.frame.reshape(3, 3)
        yield Touch(
            robot_geom=a if robot[a] else b,
            other_geom=b if robot[a] else a,
            distance=float(contact.dist),
            point_world=contact.pos.copy(),
            normal_world=sign * frame[0],
            force=float(wrench[0]),
            force_world=sign * (frame.T @ wrench[:3]),
        )


def _linear_commands(joints: Array, gripper: Array, fps: float, ticks_a_frame: int) -> Commands:
    """Commands straight from each sample (T) to the next; at the last tick the arm is commanded to stand."""
    samples = np.column_stack([joints, gripper])
    steps = np.diff(samples, axis=0)
    shares = np.arange(ticks_a_frame) / ticks_a_frame
    moving = samples[:-1, None] + shares[:, None] * steps[:, None]
    commands = np.concatenate([moving.reshape(-1, samples.shape[1]), samples[-1:]])
    velocities = np.concatenate([np.repeat(fps * steps, ticks_a_frame, 0), np.zeros((1, steps.shape[1]))])
    return Commands(commands[:, :-1], velocities[:, :-1], commands[:, -1])


def _servo_control(scene: Scene, command: Array, velocity: Array, closing: float) -> Array:
    """Actuator controls (nu,) for arm joints (J,), [rad], their velocities [rad/s], and gripper 0..1."""
    arm = scene.arm
    control = np.zeros(scene.model.nu)
    control[arm.actuators] = command + arm.kv / arm.kp * velocity
    opened, closed = scene.gripper.control_range
    control[scene.gripper.actuator] = opened + closing * (closed - opened)
    return control
