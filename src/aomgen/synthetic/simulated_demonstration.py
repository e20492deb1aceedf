"""The demonstration itself: a simulation in which only contact moves the object."""

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from aomgen.core.values import Array, freeze
from aomgen.robots.robot import RobotModel
from aomgen.simulation.replay import servo_control
from aomgen.simulation.scene import Scene
from aomgen.synthetic.commanded_trajectory import CONTROL_STEP_S, CommandedTrajectory

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


def simulate(scene: Scene, script: CommandedTrajectory) -> SimulatedDemonstration:
    """Run a script with position control and velocity feed-forward; the object's joint is passive.

    Nothing is written into the state after the first step. Autoreset is off.
    """
    model = copy.copy(scene.model)
    model.opt.timestep = CONTROL_STEP_S
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    model.actuator_forcerange[scene.gripper.actuator] *= script.grip
    data = mujoco.MjData(model)
    data.qpos[:] = scene.qpos(script.joints[:1], script.gripper[0], script.theta_start)[0]
    velocities = np.gradient(script.joints, CONTROL_STEP_S, axis=0)
    data.ctrl[:] = servo_control(scene, script.joints[0], np.zeros_like(velocities[0]), script.gripper[0])
    mujoco.mj_step(model, data, round(SETTLE_S / CONTROL_STEP_S))
    sides = _name_sides(model, scene.robot)
    qpos = np.empty((len(script.times_s), model.nq))
    contacts, foreign = [], False
    for step in range(len(script.times_s)):
        qpos[step] = data.qpos
        touches, strange = _read_touches(scene, data, sides)
        contacts.append(touches)
        foreign |= strange
        data.ctrl[:] = servo_control(scene, script.joints[step], velocities[step], script.gripper[step])
        mujoco.mj_step(model, data)
    opened, closed = scene.gripper.driver_range
    return SimulatedDemonstration(
        times_s=script.times_s,
        qpos=qpos,
        joints=qpos[:, scene.arm.qpos],
        gripper=(qpos[:, scene.gripper.driver] - opened) / (closed - opened),
        theta=qpos[:, scene.object_qpos],
        contacts=tuple(contacts),
        foreign=foreign,
        diverged=bool(data.warning.number.sum() > 0) or not np.isfinite(qpos).all(),
    )


def _read_touches(
    scene: Scene, data: mujoco.MjData, sides: dict[int, str]
) -> tuple[tuple[TrueContact, ...], bool]:
    """Touches of the hand on the moving part, and whether the robot touches anything else."""
    roles, found, strange = scene.roles, [], False
    wrench = np.zeros(6)
    for number in range(data.ncon):
        contact = data.contact[number]
        a, b = contact.geom
        if roles.robot[a] == roles.robot[b] or contact.dist > 0:
            continue
        ours, other = (a, b) if roles.robot[a] else (b, a)
        if not (roles.moving[other] and roles.gripper[ours]):
            strange = True
            continue
        mujoco.mj_contactForce(scene.model, data, number, wrench)
        normal = contact.frame[:3] * (1.0 if ours == a else -1.0)
        finger = sides[int(scene.model.geom_bodyid[ours])]
        found.append(TrueContact(finger=finger, point=contact.pos, normal=normal, force=float(wrench[0])))
    return tuple(found), strange


def _name_sides(model: mujoco.MjModel, robot: RobotModel) -> dict[int, str]:
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
