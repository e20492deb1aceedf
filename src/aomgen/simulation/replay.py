"""Simulate an arm that tracks commands in MuJoCo; the object's joint is passive and moves only by contact."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.core.demonstration import Trajectory
from aomgen.core.plan import Rejection
from aomgen.core.transforms import transform
from aomgen.core.values import Array
from aomgen.core.verdict import Setting
from aomgen.simulation.controls import (
    SETTLE_S,
    Commands,
    divide_frame,
    ignore_hand_on_hand,
    ramp,
    servo_controls,
)
from aomgen.simulation.scene import Scene
from aomgen.simulation.settings import apply_setting
from aomgen.simulation.touches import RawContacts, Touches, find_touches, read_contacts

DIVERGENCE: Final = [
    int(kind)
    for kind in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
        mujoco.mjtWarning.mjWARN_BADCTRL,
        mujoco.mjtWarning.mjWARN_INERTIA,
    )
]
# The part of MuJoCo's state on which later steps depend.
STATE: Final = mujoco.mjtState.mjSTATE_INTEGRATION


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedRun:
    """Recorded motion of a simulation at N control ticks.

    Attributes:
        frame_ticks: Tick of each commanded sample (T,).
        tick_s: Time between two ticks, [s].
        joints: Reached arm joints (N, J), [rad] or [m].
        gripper: Reached gripper (N,), 0 open .. 1 closed.
        thetas: Value of the object's joint (N,), [rad] or [m].
        rates: Velocity of the object's joint (N,), [rad/s] or [m/s].
        torques: Torques of the arm's drives (N, J), including gravity compensation, [N m] or [N].
        Ts_world_ee: Reached end-effector poses (N, 4, 4).
        bases_world: Position of the object's static link (N, 3), [m].
        commands: Commanded arm joints (N, J), [rad] or [m].
        touches: Contacts of the robot with other bodies.
        untouched: Tick and full state of the last sample before the first contact with the object; never the final sample.
    """

    frame_ticks: NDArray[np.int64]
    tick_s: float
    joints: Array
    gripper: Array
    thetas: Array
    rates: Array
    torques: Array
    Ts_world_ee: Array
    bases_world: Array
    commands: Array
    touches: Touches
    untouched: tuple[int, Array]


class Simulation:
    """Simulation of an arm that tracks one target after the other without knowledge of later ones; builds a `SimulatedRun`.

    MuJoCo's autoreset is off (see `build_scene`), so that divergence can be detected.

    Attributes:
        data: Current state.
        untouched: See `SimulatedRun`.
    """

    def __init__(
        self,
        scene: Scene,
        fps: float,
        target: Array,
        setting: Setting | None = None,
        initial_theta: float = 0.0,
        resumed: tuple[int, Array] | None = None,
    ) -> None:
        """Let the arm settle at the first target, or resume from a state.

        Args:
            scene: Simulated scene.
            fps: Frames per second.
            target: First target (J + 1,), joints and gripper.
            setting: Resistance of the object; None keeps that of the scene.
            initial_theta: Value of the object's joint at the start, [rad] or [m].
            resumed: Tick and state from which the simulation continues, see `SimulatedRun.untouched`.
        """
        self._fps, self._scene, self._setting = fps, scene, setting
        self._model = model = copy.copy(scene.model)
        self._ticks, self._steps, model.opt.timestep = divide_frame(fps, model.opt.timestep)
        ignore_hand_on_hand(scene, model)
        if setting is not None:
            apply_setting(scene, model, setting, initial_theta)
        self._target = target
        self._rows: list[tuple[Array, ...]] = []
        self._contacts: list[RawContacts] = []
        self._commands: list[Array] = []
        self._tick, self._near = 0, resumed is not None
        if resumed is None:
            start = scene.qpos(target[None, :-1], target[-1], initial_theta)[0]
            self.data = stand(scene, model, start, ramp(target, target, fps, 1), SETTLE_S)
            self.untouched = _state_of(model, self.data, 0)
        else:
            self._tick, self.untouched, self.data = resumed[0], resumed, mujoco.MjData(model)
            mujoco.mj_setState(model, self.data, resumed[1], STATE)

    def follow(self, target: Array) -> None:
        """Command a linear motion over one frame from the last target to this one (J + 1,), joints and gripper."""
        commands = ramp(self._target, target, self._fps, self._ticks)
        first = self._tick
        for _ in track(self._scene, self._model, self.data, commands, self._steps):
            contacts = self._read()
            self._rows.append(_read_row(self._scene, self.data))
            self._contacts += contacts
            self._near = self._near or any(self._scene.roles.object[item.geoms].any() for item in contacts)
            if self._tick == first and not self._near:
                self.untouched = _state_of(self._model, self.data, first)
            self._tick += 1
        self._commands.append(commands.joints)
        self._target = target

    def check_divergence(self) -> Rejection | None:
        """Return a Rejection "diverged" if MuJoCo has issued a warning about divergence, else None."""
        if not self.data.warning.number[DIVERGENCE].any():
            return None
        time_s = self._tick / (self._fps * self._ticks)
        detail = f"the simulation became unstable at {time_s:.2f} s"
        return Rejection(reason="diverged", detail=detail, metrics={"time_s": time_s})

    def read_state(self) -> Trajectory:
        """Return the current state of robot and object as a trajectory of one sample."""
        now = _stack(self._scene, [_read_row(self._scene, self.data)])
        return Trajectory(
            times_s=np.array([self._tick / (self._fps * self._ticks)]),
            joints=now["joints"],
            gripper=now["gripper"],
            thetas=now["thetas"],
        )

    def run(self) -> SimulatedRun:
        """Return the recorded run, including the current state; a resumed simulation returns the part after resumption."""
        frames, ticks = len(self._commands) + 1, self._ticks
        contacts = [*self._contacts, *self._read()]
        return SimulatedRun(
            frame_ticks=ticks * np.arange(frames),
            tick_s=1 / (self._fps * ticks),
            commands=np.concatenate([*self._commands, self._target[None, :-1]]),
            touches=find_touches(self._scene, contacts),
            untouched=self.untouched,
            **_stack(self._scene, [*self._rows, _read_row(self._scene, self.data)]),
        )

    def _read(self) -> list[RawContacts]:
        """Read the contacts of this tick, and update the friction of a latch for the current joint value."""
        if self._setting is not None and self._setting.latch:
            theta = self.data.qpos[self._scene.object_qpos]
            self._model.dof_frictionloss[self._scene.object_dof] = self._setting.friction_at(theta)
        return [read_contacts(self._model, self.data, self._tick)] if self.data.ncon else []


def simulate(
    scene: Scene,
    joints: Array,
    gripper: Array,
    fps: float,
    *,
    setting: Setting | None = None,
    approach: SimulatedRun | None = None,
    initial_theta: float = 0.0,
) -> SimulatedRun | Rejection:
    """Simulate the arm's position controllers while they track a trajectory of T >= 2 samples.

    Between samples t and t + 1, the command moves linearly from one to the other. It thus depends only on the exported
    action at t, which is the target at t + 1, and on the previous action.

    Args:
        scene: Scene with the object at its pose.
        joints: Commanded arm joints (T, J), [rad] or [m].
        gripper: Commanded gripper (T,), 0 open .. 1 closed.
        fps: Samples per second.
        setting: Resistance of the object; None keeps that of the scene.
        approach: A run of the same commands with another setting. Both runs are equal until the robot touches the object,
            so this run starts from its `untouched` state.
        initial_theta: Value of the object's joint at the start, [rad] or [m].

    Returns:
        The run; or a Rejection "diverged" if the simulation diverges.
    """
    samples = np.column_stack([joints, gripper])
    first, resumed = 0, None
    if approach is not None:
        resumed = approach.untouched
        first = int(np.searchsorted(approach.frame_ticks, resumed[0]))
    simulation = Simulation(scene, fps, samples[first], setting, initial_theta, resumed)
    for target in samples[first + 1 :]:
        simulation.follow(target)
        if lost := simulation.check_divergence():
            return lost
    run = simulation.run()
    return run if approach is None else _join(approach, run)


def stand(
    scene: Scene, model: mujoco.MjModel, start: Array, commands: Commands, settle_s: float
) -> mujoco.MjData:
    """Return the state after the arm has held the first command, until servos and contacts are at rest.

    Args:
        scene: Addresses in the model.
        model: Model of the scene, possibly with another time step.
        start: Initial positions (nq,).
        commands: Commands, of which the first is held.
        settle_s: Simulated time, [s].
    """
    data = mujoco.MjData(model)
    data.qpos[:] = start
    still = Commands(commands.joints[:1], np.zeros_like(commands.joints[:1]), commands.gripper[:1])
    data.ctrl[:] = servo_controls(scene, still)[0]
    mujoco.mj_step(model, data, round(settle_s / model.opt.timestep))
    return data


def track(
    scene: Scene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    commands: Commands,
    steps_a_tick: int = 1,
) -> Iterator[mujoco.MjData]:
    """Drive arm and gripper by position control, and yield the state at every tick before its command is applied.

    Velocity feed-forward, `ctrl = q + kv / kp * dq`, compensates for the lag of a position actuator. Positions and
    velocities are never set directly.

    Args:
        scene: Addresses in the model.
        model: Model of the scene, possibly with another time step.
        data: State at the first tick, changed in place.
        commands: Commands at every tick.
        steps_a_tick: Simulation steps per tick.
    """
    for control in servo_controls(scene, commands):
        yield data
        data.ctrl[:] = control
        mujoco.mj_step(model, data, steps_a_tick)


def _state_of(model: mujoco.MjModel, data: mujoco.MjData, tick: int) -> tuple[int, Array]:
    state = np.empty(mujoco.mj_stateSize(model, STATE))
    mujoco.mj_getState(model, data, state, STATE)
    return tick, state


def _read_row(scene: Scene, data: mujoco.MjData) -> tuple[Array, ...]:
    """Copy the values of a tick for `_stack`: qpos, qvel, torques, end-effector position and rotation, object position."""
    return (
        data.qpos.copy(),
        data.qvel.copy(),
        data.qfrc_actuator + data.qfrc_gravcomp,
        data.site_xpos[scene.ee_site].copy(),
        data.site_xmat[scene.ee_site].copy(),
        data.xpos[scene.object_body].copy(),
    )


def _stack(scene: Scene, rows: list[tuple[Array, ...]]) -> dict[str, Array]:
    """Convert the rows of all ticks to fields of a `SimulatedRun`."""
    qpos, qvel, torques, points, turns, bases = (np.array(column) for column in zip(*rows, strict=True))
    opened, closed = scene.gripper.driver_range
    driver = scene.model.joint(scene.gripper.driver).qposadr[0]
    return {
        "joints": qpos[:, scene.arm.qpos],
        "gripper": np.clip((qpos[:, driver] - opened) / (closed - opened), 0, 1),
        "thetas": qpos[:, scene.object_qpos],
        "rates": qvel[:, scene.object_dof],
        "torques": torques[:, scene.arm.dofs],
        "Ts_world_ee": transform(turns.reshape(-1, 3, 3), points),
        "bases_world": bases,
    }


def _join(approach: SimulatedRun, rest: SimulatedRun) -> SimulatedRun:
    """Concatenate the ticks of an approach up to its `untouched` state and those of a run that was resumed from it."""
    last = approach.untouched[0]
    early = approach.touches.ticks <= last
    # A restored state has no forces before its first step, so that tick is taken from the approach.
    names = ("joints", "gripper", "thetas", "rates", "torques", "Ts_world_ee", "bases_world")
    values = {
        name: np.concatenate([getattr(approach, name)[: last + 1], getattr(rest, name)[1:]]) for name in names
    }
    touches = {
        item.name: np.concatenate(
            [getattr(approach.touches, item.name)[early], getattr(rest.touches, item.name)]
        )
        for item in fields(Touches)
    }
    return replace(approach, touches=Touches(**touches), **values)
