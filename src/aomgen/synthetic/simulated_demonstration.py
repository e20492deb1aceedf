"""The demonstration itself: a simulation in which only contact moves the object."""

from dataclasses import dataclass

import mujoco
import numpy as np

from aomgen.core.values import Array, freeze
from aomgen.errors import ConfigError
from aomgen.robots.robot import HandDrive, RobotModel
from aomgen.synthetic.commanded_trajectory import CONTROL_STEP_S, CommandedTrajectory
from aomgen.synthetic.layout import World

# Simulated time before the log begins, in which servos and contacts come to rest, [s].
SETTLE_S = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueContact:
    """A touch of the hand on the moving part, world frame.

    Attributes:
        finger: "left", "right" or "palm".
        point: (3,), [m].
        normal: Unit direction (3,) from the hand into the part.
        force: Normal component, [N].
    """

    finger: str
    point: Array
    normal: Array
    force: float

    def __post_init__(self) -> None:
        for name in ("point", "normal"):
            freeze(self, name, getattr(self, name), (3,))


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedDemonstration:
    """What happened, every CONTROL_STEP_S.

    Attributes:
        times_s: (T,) from 0.
        qpos: Generalised positions (T, nq) of the whole model.
        joints: Arm joints (T, J), [rad].
        gripper: Measured driver angle as a share of its stroke (T,).
        theta: Joint value of the object (T,), [rad] or [m].
        contacts: For each step, the hand's touches on the moving part.
        foreign: Whether the arm ever touched anything else of object or table.
        diverged: Whether the simulation warned.
    """

    times_s: Array
    qpos: Array
    joints: Array
    gripper: Array
    theta: Array
    contacts: tuple[tuple[TrueContact, ...], ...]
    foreign: bool
    diverged: bool

    def __post_init__(self) -> None:
        count = len(self.times_s)
        for name in ("gripper", "theta"):
            freeze(self, name, getattr(self, name), (count,))
        for name in ("qpos", "joints"):
            freeze(self, name, getattr(self, name), (count, None))


def simulate(robot: RobotModel, world: World, script: CommandedTrajectory) -> SimulatedDemonstration:
    """Run a script with position control and velocity feed-forward; the object's joint is passive.

    Nothing is written into the state after the first step. Autoreset is off.
    """
    model = world.model
    model.opt.timestep = CONTROL_STEP_S
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    model.actuator_forcerange[model.actuator(_drive(robot).actuator).id] *= script.grip
    data = mujoco.MjData(model)
    at_rest = robot.qpos(script.joints[0], script.gripper[0])[0]
    data.qpos[: len(at_rest)] = at_rest
    data.joint(world.names.joint).qpos[0] = script.theta_start
    control = _Control(robot, model)
    velocities = np.gradient(script.joints, CONTROL_STEP_S, axis=0)
    control.apply(data, script.joints[0], velocities[0] * 0, script.gripper[0])
    for _ in range(round(SETTLE_S / CONTROL_STEP_S)):
        mujoco.mj_step(model, data)
    hand = _Hand(robot, world)
    qpos = np.empty((len(script.times_s), model.nq))
    contacts, foreign = [], False
    for step in range(len(script.times_s)):
        qpos[step] = data.qpos
        touches, strange = hand.touches(data)
        contacts.append(touches)
        foreign |= strange
        control.apply(data, script.joints[step], velocities[step], script.gripper[step])
        mujoco.mj_step(model, data)
    drive = _drive(robot)
    opened, closed = drive.driver_range
    columns = [model.joint(name).qposadr[0] for name in robot.joint_names]
    return SimulatedDemonstration(
        times_s=script.times_s,
        qpos=qpos,
        joints=qpos[:, columns],
        gripper=(qpos[:, model.joint(drive.driver).qposadr[0]] - opened) / (closed - opened),
        theta=qpos[:, model.joint(world.names.joint).qposadr[0]],
        contacts=tuple(contacts),
        foreign=foreign,
        diverged=bool(data.warning.number.sum() > 0) or not np.isfinite(qpos).all(),
    )


def _drive(robot: RobotModel) -> HandDrive:
    if robot.drive is None:
        raise ConfigError(
            robot.name, "has no fingers that could open anything", "give an arm with its gripper"
        )
    return robot.drive


def _branches(model: mujoco.MjModel, robot: RobotModel) -> dict[int, str]:
    """Side of every body between a finger pad and the palm, and of all that hangs on those."""
    hand = {model.body(name).id for name in robot.hand_bodies}
    arms = {int(model.jnt_bodyid[model.joint(name).id]) for name in robot.gripper_table.joint_names}
    sides: dict[int, str] = {}
    for pad in robot.pads:
        body = model.body(robot.body_names[pad.body]).id
        while body in hand:
            moved, root = body in arms, body
            body = int(model.body_parentid[body])
            if moved:
                sides[root] = pad.finger
    for body in sorted(hand):
        sides.setdefault(body, sides.get(int(model.body_parentid[body]), "palm"))
    return sides


class _Control:
    """Writes actuator commands: position servos whose lag is cancelled by velocity feed-forward."""

    def __init__(self, robot: RobotModel, model: mujoco.MjModel) -> None:
        of_joint = {model.actuator_trnid[a, 0]: a for a in range(model.nu) if model.actuator_trntype[a] == 0}
        self._arm = np.array([of_joint[model.joint(name).id] for name in robot.joint_names])
        self._lead = model.actuator_biasprm[self._arm, 2] / model.actuator_biasprm[self._arm, 1]
        drive = _drive(robot)
        self._opened, self._closed = drive.control_range
        self._gripper = model.actuator(drive.actuator).id

    def apply(self, data: mujoco.MjData, joints: Array, velocities: Array, gripper: float) -> None:
        data.ctrl[self._arm] = joints + self._lead * velocities
        data.ctrl[self._gripper] = self._opened + gripper * (self._closed - self._opened)


class _Hand:
    """Reads the contacts between robot, object and table."""

    def __init__(self, robot: RobotModel, world: World) -> None:
        self._model = world.model
        bodies = [self._model.body(b).name for b in self._model.geom_bodyid]
        self._robot = np.array([name in robot.body_names for name in bodies])
        self._moving = np.array([name == world.names.moving_body for name in bodies])
        self._hand = np.array([name in robot.hand_bodies for name in bodies])
        branch = _branches(self._model, robot)
        self._finger = [branch.get(int(b), "palm") for b in self._model.geom_bodyid]

    def touches(self, data: mujoco.MjData) -> tuple[tuple[TrueContact, ...], bool]:
        """Touches of the hand on the moving part, and whether the robot touches anything else."""
        found, strange = [], False
        wrench = np.zeros(6)
        for number in range(data.ncon):
            contact = data.contact[number]
            a, b = contact.geom
            if self._robot[a] == self._robot[b] or contact.dist > 0:
                continue
            ours, other = (a, b) if self._robot[a] else (b, a)
            if not (self._moving[other] and self._hand[ours]):
                strange = True
                continue
            mujoco.mj_contactForce(self._model, data, number, wrench)
            normal = contact.frame[:3] * (1.0 if ours == a else -1.0)
            finger = self._finger[ours]
            found.append(TrueContact(finger=finger, point=contact.pos, normal=normal, force=float(wrench[0])))
        return tuple(found), strange
