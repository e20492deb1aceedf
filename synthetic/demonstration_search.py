"""A demonstration that succeeded: drawn, planned, simulated by contact alone and judged until one does."""

import copy
from dataclasses import dataclass
from typing import Annotated

import mujoco
import numpy as np

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.joint import Joint
from aomgen.core.values import Array, Vector3, freeze_arrays
from aomgen.errors import ConfigError
from aomgen.robots.robot import RobotModel
from aomgen.simulation.controls import Commands
from aomgen.simulation.replay import stand, track
from aomgen.simulation.scene import Scene
from aomgen.simulation.touches import Touches, find_touches, read_contacts
from synthetic.commanded_trajectory import CONTROL_STEP_S, CommandedTrajectory
from synthetic.demonstration_planning import plan
from synthetic.grasp_selection import list_grasp_types
from synthetic.layout import SceneLayout, build_world, draw_layout
from synthetic.style import MOVED, DemonstrationStyle

# Layouts that are tried before a seed is given up.
MAX_TRIES = 80
# Damping that holds a locked part, [N m s/rad] or [N s/m].
LOCKED_DAMPING = 1e6
# A part that is pushed may coast beyond the end of the push, up to this many times its travel.
COAST = 1.3
# Force that counts as a touch, [N].
FELT_N = 1.0
# Simulated time before the log begins, in which servos and contacts come to rest, [s].
SETTLE_S = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueContact:
    """A contact of the gripper with the moving part, world frame.

    Attributes:
        finger: "left", "right" or "palm".
        point: (3,), [m].
        normal: Unit direction (3,) from the gripper into the part.
        force: Normal component, [N].
    """

    finger: str
    point: Vector3
    normal: Vector3
    force: float

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedDemonstration:
    """Simulated demonstration, every CONTROL_STEP_S.

    Attributes:
        times_s: (T,) from 0.
        qpos: States of the whole model (T, nq).
        joints: (T, J), [rad].
        gripper: Measured share of its stroke (T,).
        theta: Joint value of the object (T,), [rad] or [m].
        contacts: For each step, the gripper's contacts with the moving part.
        foreign: Whether the arm ever touched anything else of object or table.
        diverged: Whether the simulation warned.
    """

    times_s: Annotated[Array, "T"]
    qpos: Annotated[Array, "T _"]
    joints: Annotated[Array, "T _"]
    gripper: Annotated[Array, "T"]
    theta: Annotated[Array, "T"]
    contacts: tuple[tuple[TrueContact, ...], ...]
    foreign: bool
    diverged: bool

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Performance:
    """A demonstration that succeeded, in its setting and style."""

    layout: SceneLayout
    style: DemonstrationStyle
    script: CommandedTrajectory
    demonstration: SimulatedDemonstration

    @property
    def joint(self) -> Joint:
        """The joint as demonstrated, world frame: axis in the demonstrated direction, 0 = scanned state."""
        joint, style = self.layout.joint_world, self.style
        return orient_joint(joint, style.start, style.sign)

    @property
    def theta(self) -> Array:
        """Demonstrated joint value at each step (T,), [rad] or [m]."""
        return self.style.sign * (self.demonstration.theta - self.style.start)


def orient_joint(joint: Joint, start: float, sign: float) -> Joint:
    """A joint whose value counts from `start`, in the direction of `sign`."""
    ends = sorted((sign * (joint.lower - start), sign * (joint.upper - start)))
    return Joint(type=joint.type, axis=sign * joint.axis, origin=joint.origin, lower=ends[0], upper=ends[1])


def find_demonstration(
    robot: RobotModel,
    asset: ArticulatedAsset,
    rng: np.random.Generator,
    style: DemonstrationStyle | None = None,
) -> Performance:
    """Draw layouts until one demonstration moves the object by contact with the handle alone.

    Args:
        style: Style of the demonstration; None selects a random pinch that opens the object.

    Raises:
        ConfigError: None of MAX_TRIES does, or the object cannot be touched in this style.
    """
    if style is not None and style.touch not in (known := list_grasp_types(asset, style.direction)):
        what = f"cannot be moved by a {style.touch} when {style.direction}"
        raise ConfigError(asset.name, what, f"choose {' or '.join(known)}")
    for _ in range(MAX_TRIES):
        layout = draw_layout(asset, rng)
        scene = build_world(robot, layout, visual=False)
        planned = plan(scene, layout, rng, style)
        if planned is None:
            continue
        if planned[0].outcome == "locked":
            scene.model.dof_damping[scene.object_dof] = LOCKED_DAMPING
        shown = simulate(scene, planned[1])
        performance = Performance(layout=layout, style=planned[0], script=planned[1], demonstration=shown)
        if not shown.diverged and not shown.foreign and _succeeded(performance):
            return performance
    raise ConfigError(asset.name, f"no demonstration succeeds in {MAX_TRIES} settings", "choose another seed")


def _succeeded(performance: Performance) -> bool:
    """Return whether the demonstration matches its style.

    A part that moves reaches at least 90 % of its travel and stays within 10 % after release; one
    that is not gripped may coast on.
    """
    theta, style = performance.theta, performance.style
    travel = style.travel
    if style.outcome in ("moves", "cut"):
        goal = travel if style.touch == "pinch" else float(np.clip(theta.max(), travel, COAST * travel))
        return bool(theta.max() >= 0.9 * travel and abs(theta[-1] - goal) <= 0.1 * travel)
    pressed = any(touch.force > FELT_N for touches in performance.demonstration.contacts for touch in touches)
    still = np.abs(theta).max() < MOVED[performance.joint.type] / 2
    return bool(still and pressed == (style.outcome != "nothing"))


def simulate(scene: Scene, script: CommandedTrajectory) -> SimulatedDemonstration:
    """Run a script; the object's joint is passive. Autoreset is off."""
    model = copy.copy(scene.model)
    model.opt.timestep = CONTROL_STEP_S
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    model.actuator_forcerange[model.actuator(scene.gripper.actuator).id] *= script.grip
    start = scene.qpos(script.joints[:1], script.gripper[0], script.theta_start)[0]
    commands = Commands(script.joints, np.gradient(script.joints, CONTROL_STEP_S, axis=0), script.gripper)
    qpos = np.empty((len(script.times_s), model.nq))
    touched, warned = [], False
    data = stand(scene, model, start, commands, SETTLE_S)
    for step, _ in enumerate(track(scene, model, data, commands)):
        qpos[step] = data.qpos
        if data.ncon:
            touched.append(read_contacts(model, data, step))
        warned = bool(data.warning.number.sum() > 0)
    contacts, foreign = _sort_touches(scene, find_touches(scene, touched), len(qpos))
    opened, closed = scene.gripper.driver_range
    driver = model.joint(scene.gripper.driver).qposadr[0]
    return SimulatedDemonstration(
        times_s=script.times_s,
        qpos=qpos,
        joints=qpos[:, scene.arm.qpos],
        gripper=(qpos[:, driver] - opened) / (closed - opened),
        theta=qpos[:, scene.object_qpos],
        contacts=contacts,
        foreign=foreign,
        diverged=warned or not np.isfinite(qpos).all(),
    )


def _sort_touches(
    scene: Scene, touches: Touches, steps: int
) -> tuple[tuple[tuple[TrueContact, ...], ...], bool]:
    """Contacts of the gripper with the moving part at every step, and whether the robot touches anything else."""
    roles, sides = scene.roles, _name_sides(scene.model, scene.robot)
    near = touches.distances <= 0
    wanted = roles.moving[touches.other_geoms] & roles.gripper[touches.robot_geoms]
    found: list[list[TrueContact]] = [[] for _ in range(steps)]
    for row in np.flatnonzero(near & wanted).tolist():
        finger = sides[int(scene.model.geom_bodyid[touches.robot_geoms[row]])]
        contact = TrueContact(
            finger=finger,
            point=touches.points_world[row],
            normal=-touches.normals_world[row],
            force=float(touches.forces[row]),
        )
        found[touches.ticks[row]].append(contact)
    return tuple(tuple(contacts) for contacts in found), bool(np.any(near & ~wanted))


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
