"""Run a commanded trajectory in MuJoCo: the object's joint is passive, only contact moves it."""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator, PchipInterpolator

from aomgen.core.transforms import transform
from aomgen.core.values import Array
from aomgen.core.verdict import Rejection
from aomgen.physics.scene import Scene

CONTROL_HZ = 125.0
SETTLE_S = 0.2
DIVERGENCE = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_BADCTRL,
    mujoco.mjtWarning.mjWARN_INERTIA,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Touch:
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
        times_s: (N,), from the start of the episode.
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

    times_s: Array
    joints: Array
    gripper: Array
    thetas: Array
    Ts_world_ee: Array
    commands: Array
    pad_forces: Array
    reactions: Array
    drift_m: Array
    touches: tuple[Touch, ...]

    def sampled(self, times_s: Array) -> NDArray[np.int64]:
        """Tick nearest to each time (T,)."""
        rate = CONTROL_HZ
        return np.clip(np.round(np.asarray(times_s) * rate).astype(np.int64), 0, len(self.times_s) - 1)


def simulate(
    scene: Scene, joints: Array, gripper: Array, fps: float, *, initial_theta: float = 0.0
) -> SimulatedRun | Rejection:
    """Track a trajectory with the arm's position controllers.

    Commands are interpolated smoothly to 125 Hz and sent with velocity feed-forward,
    `ctrl = q + kv / kp * dq`, which takes the lag out of a position actuator. The object's
    joint is written once, at reset. Autoreset is off (see `build_scene`) and a warning of divergence ends the run.

    Args:
        scene: Object placed, resistance set.
        joints: Commanded arm joints (T, J), [rad].
        gripper: Commanded gripper (T,), 0..1.
        fps: Samples a second of both.
        initial_theta: Object joint at reset; anything but 0 is for tests.

    Returns:
        The run; or a Rejection "diverged".
    """
    model = scene.model
    data = mujoco.MjData(model)
    data.qpos[:] = scene.qpos(joints[:1], gripper[0], initial_theta)[0]
    ticks, controls, commands = _controls(scene, joints, gripper, fps)
    steps = max(round(1.0 / CONTROL_HZ / model.opt.timestep), 1)
    data.ctrl[:] = controls[0]
    start_base = _base_position(scene, data)
    mujoco.mj_step(model, data, round(SETTLE_S / model.opt.timestep))
    log = _Log(scene=scene, count=len(ticks), start_base=start_base)
    for tick, control in enumerate(controls):
        log.record(tick, data)
        data.ctrl[:] = control
        mujoco.mj_step(model, data, steps)
        if any(data.warning[kind].number for kind in DIVERGENCE):
            return Rejection(
                reason="diverged",
                detail=f"the simulation became unstable at {ticks[tick]:.2f} s",
                metrics={"time_s": float(ticks[tick])},
            )
    return log.finished(ticks, commands)


def _controls(scene: Scene, joints: Array, gripper: Array, fps: float) -> tuple[Array, Array, Array]:
    """Tick times (N,), actuator controls (N, nu) and commanded joints (N, J)."""
    times = np.arange(len(joints)) / fps
    ticks = np.arange(int(times[-1] * CONTROL_HZ) + 1) / CONTROL_HZ
    # Akima: smooth like a cubic spline, but still where the samples are still.
    curve = Akima1DInterpolator(times, joints)
    commands = curve(ticks)
    controls = np.zeros((len(ticks), scene.model.nu))
    arm = scene.arm
    controls[:, arm.actuators] = commands + arm.kv / arm.kp * curve.derivative()(ticks)
    closing = np.clip(PchipInterpolator(times, gripper)(ticks), 0, 1)
    opened, closed = scene.gripper.control_range
    controls[:, scene.gripper.actuator] = opened + closing * (closed - opened)
    return ticks, controls, commands


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
        self.touches: list[Touch] = []

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
                    Touch(
                        tick=tick,
                        finger=finger,
                        point_world=contact.pos.copy(),
                        normal_world=sign * frame[0],
                        force=float(wrench[0]),
                    )
                )
        self.reactions[tick] = float(np.linalg.norm(total[:2]))

    def finished(self, ticks: Array, commands: Array) -> SimulatedRun:
        return SimulatedRun(
            times_s=ticks,
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
