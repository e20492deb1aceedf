"""Preparation of a robot for simulation: position servos, finger pads, and exclusion of false contacts.

Model files have torque motors, weak gains or, like all URDFs, no actuators. The result of a replay must not depend on these,
so every robot gets the same kind of servos, with the stiffness and bandwidth of the controllers of real arms.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import COLLIDER_GROUP, VISUAL_GROUP
from aomgen.core.values import Array
from aomgen.io.geom_surface import find_visible_geoms
from aomgen.io.mujoco_model import compile_model
from aomgen.robots.description import ActuatorSection, GripperSection, PadSection
from aomgen.robots.reading import ArmChain

# Stiffness of a revolute joint, measured at the end effector, [N/m]: 50 N move it by 1 cm, as in the model of the UR5e.
# Joints whose axes pass near the end effector get the stiffness that corresponds to the lever LEAST_LEVER_M, [m].
END_STIFFNESS, LEAST_LEVER_M = 5000.0, 0.3
# Stiffness of a prismatic joint, [N/m]: a load of 1 kg moves it by half a millimeter.
SLIDE_STIFFNESS: Final = 20_000.0
# Largest natural frequency of a servo, [rad/s], far below the rate of the simulation's steps; armature is added to limit it.
MAX_RATE: Final = 100.0
# Grip force of the pads, [N]; common parallel grippers have 20 to 140 N. The servo reaches it at a position error of the share
# GRIP_GIVE of the stroke.
GRIP_FORCE_N, GRIP_GIVE = 50.0, 0.05
# Number of random arm configurations from which levers, inertias and overlaps are determined.
SAMPLES: Final = 40


def sort_shapes(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Assign the geoms of a robot to the visual or the collision group, and set explicit inertias of its bodies.

    Args:
        spec: Description of the robot, changed in place.
        model: Compiled model of `spec`.
    """
    for number, seen in enumerate(find_visible_geoms(model)):
        spec.geom(model.geom(number).name).group = VISUAL_GROUP if seen else COLLIDER_GROUP
    _fix_inertias(spec, model)


def add_actuation(
    specs: Sequence[mujoco.MjSpec],
    chain: ArmChain,
    ee_site: str,
    gripper: GripperSection | None,
    pad_way_m: float,
    path: Path,
) -> ActuatorSection | None:
    """Add pad boxes, servos and contact exclusions to a robot.

    Args:
        specs: Descriptions of the same robot, changed in place; the last one, which is compiled, should be the smallest.
        chain: Joints and bodies of the arm and the gripper.
        ee_site: Name of the end effector site.
        gripper: Description of the gripper, or None.
        pad_way_m: Distance by which the pads approach each other from open to closed.
        path: File of the robot, for messages.

    Returns:
        Actuator of the gripper; None without a gripper.

    Raises:
        MalformedFileError: MuJoCo cannot compile the robot.
    """
    if gripper is not None:
        model = compile_model(specs[-1], path)
        for spec in specs:
            for side, pad in gripper.pads.items():
                _add_pad(spec, side, pad)
            _tie_drivers(spec, model, gripper.strokes)
    model = compile_model(specs[-1], path)
    actuator = None
    contacts = _false_contacts(model, chain)
    servos = _arm_servos(model, chain.joints, ee_site)
    for spec in specs:
        _add_arm_servos(spec, servos)
        for a, b in contacts:
            spec.add_exclude(name=f"apart_{a}_{b}", bodyname1=a, bodyname2=b)
        if gripper is not None:
            actuator = _add_grip_servo(spec, gripper.strokes, pad_way_m)
    return actuator


def drop_visual(spec: mujoco.MjSpec) -> None:
    """Remove visual geoms and their meshes from a description; this is fifty times slower after it has been compiled."""
    for geom in list(spec.geoms):
        if geom.contype == 0 and geom.conaffinity == 0 and geom.group == VISUAL_GROUP:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms if geom.meshname}
    for mesh in list(spec.meshes):
        if (mesh.name or Path(mesh.file).stem) not in used:
            spec.delete(mesh)


def _fix_inertias(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Set explicit masses and inertias of all bodies, so that they do not depend on the geoms."""
    for number in range(1, model.nbody):
        body = spec.body(model.body(number).name)
        body.explicitinertial = True
        body.mass = model.body_mass[number]
        body.ipos, body.iquat = model.body_ipos[number], model.body_iquat[number]
        body.inertia = model.body_inertia[number]
        body.fullinertia = np.full(6, np.nan)


def _add_pad(spec: mujoco.MjSpec, side: str, pad: PadSection) -> None:
    geom = spec.body(pad.body).add_geom(
        name=f"pad_{side}", type=mujoco.mjtGeom.mjGEOM_BOX, mass=0.0, group=COLLIDER_GROUP,
        pos=pad.center, quat=pad.quat_wxyz, size=pad.half_extents,
    )  # fmt: skip
    # These contact parameters represent rubber, which has high friction and is slightly compliant.
    geom.friction, geom.condim, geom.priority = [0.8, 0.01, 0.0005], 4, 1
    geom.solref, geom.solimp = [0.004, 1.0], [0.95, 0.99, 0.001, 0.5, 2.0]


def _tie_drivers(
    spec: mujoco.MjSpec, model: mujoco.MjModel, strokes: Mapping[str, tuple[float, float]]
) -> None:
    """Constrain the other driving joints to follow the first one linearly."""
    (first, (start, end)), *others = strokes.items()
    for name, (other_start, other_end) in others:
        ratio = (other_end - other_start) / (end - start)
        zero, other_zero = (float(model.qpos0[model.joint(n).qposadr[0]]) for n in (first, name))
        offset = other_start - other_zero - ratio * (start - zero)
        spec.add_equality(
            name=f"follow_{name}",
            type=mujoco.mjtEq.mjEQ_JOINT,
            name1=name,
            name2=first,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            data=np.array([offset, ratio, *np.zeros(10)]),
        )


def _arm_servos(
    model: mujoco.MjModel, joints: tuple[str, ...], ee_site: str
) -> dict[str, tuple[float, float]]:
    """Compute the stiffness of the servo of each arm joint, [N m/rad] or [N/m], and the largest inertia of the joint."""
    levers, inertias = _levers_and_inertias(model, joints, model.site(ee_site).id)
    slides = [int(model.joint(name).type[0]) == mujoco.mjtJoint.mjJNT_SLIDE for name in joints]
    turning = END_STIFFNESS * np.maximum(levers, LEAST_LEVER_M) ** 2
    stiffness = np.where(slides, SLIDE_STIFFNESS, turning)
    return {name: (float(stiffness[k]), float(inertias[k])) for k, name in enumerate(joints)}


def _add_arm_servos(spec: mujoco.MjSpec, servos: Mapping[str, tuple[float, float]]) -> None:
    """Add a critically damped position servo to each arm joint.

    Damping and friction of the joints in the file are removed, as drives of real arms compensate them.
    """
    for name, (kp, inertia) in servos.items():
        mass = max(inertia, kp / MAX_RATE**2)
        joint = spec.joint(name)
        joint.damping, joint.frictionloss = np.zeros(3), 0.0
        joint.armature = max(joint.armature, kp / MAX_RATE**2 - inertia)
        _servo(spec, name, kp, 2.0 * np.sqrt(kp * mass), np.inf)


def _add_grip_servo(
    spec: mujoco.MjSpec, strokes: Mapping[str, tuple[float, float]], pad_way_m: float
) -> ActuatorSection:
    (driver, (start, end)), *_ = strokes.items()
    stroke = abs(end - start)
    # Virtual work: the force of the driving joint times its stroke equals the grip force times the travel of the pads.
    force = GRIP_FORCE_N * pad_way_m / stroke
    kp = force / (GRIP_GIVE * stroke)
    joint = spec.joint(driver)
    joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    joint.armature = max(joint.armature, kp / MAX_RATE**2)
    name = _servo(spec, driver, kp, 2.0 * np.sqrt(kp * joint.armature), force)
    return ActuatorSection(name=name, open=start, closed=end)


def _servo(spec: mujoco.MjSpec, joint: str, kp: float, kv: float, limit: float) -> str:
    gain, bias = np.zeros(10), np.zeros(10)
    gain[0], bias[1], bias[2] = kp, -kp, -kv
    actuator = spec.add_actuator(
        name=f"servo_{joint}",
        target=joint,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        gainprm=gain,
        biasprm=bias,
    )
    actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    if np.isfinite(limit):
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = [-limit, limit]
    return actuator.name


def _levers_and_inertias(model: mujoco.MjModel, joints: tuple[str, ...], site: int) -> tuple[Array, Array]:
    """Compute the largest lever (J,) [m] of the end effector about each joint, and the largest inertia (J,) of the joint.

    The maxima are over random arm configurations.
    """
    data = mujoco.MjData(model)
    dofs = np.array([model.joint(name).dofadr[0] for name in joints])
    levers, inertias = np.zeros(len(joints)), np.zeros(len(joints))
    full = np.zeros((model.nv, model.nv))
    jacobian = np.zeros((3, model.nv))
    for qpos in _sample_configurations(model, joints, SAMPLES):
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        mujoco.mj_jacSite(model, data, jacobian, None, site)
        levers = np.maximum(levers, np.linalg.norm(jacobian[:, dofs], axis=0))
        inertias = np.maximum(inertias, np.diag(full)[dofs])
    return levers, inertias


def _sample_configurations(model: mujoco.MjModel, joints: tuple[str, ...], count: int) -> Array:
    """Sample states (count, nq) with random arm joints within their limits and within half a turn of 0, from a fixed seed.

    A range that is entirely beyond half a turn is sampled as a whole.
    """
    rng = np.random.default_rng(0)
    states = np.repeat(model.qpos0[None], count, 0)
    for name in joints:
        joint = model.joint(name)
        low, high = joint.range if joint.limited[0] else (-np.pi, np.pi)
        if low <= np.pi and high >= -np.pi:
            low, high = max(low, -np.pi), min(high, np.pi)
        states[:, joint.qposadr[0]] = rng.uniform(low, high, count)
    return states


def _structural_overlaps(model: mujoco.MjModel, joints: tuple[str, ...]) -> list[tuple[str, str]]:
    """Find pairs of bodies that overlap in nearly all arm configurations, because their collision shapes are inaccurate."""
    data = mujoco.MjData(model)
    counts: dict[tuple[int, int], int] = {}
    for qpos in _sample_configurations(model, joints, SAMPLES):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        pairs: NDArray[np.int64] = np.array(
            [[model.geom_bodyid[g] for g in contact.geom] for contact in data.contact if contact.dist < 0]
        ).reshape(-1, 2)
        for a, b in {(min(pair), max(pair)) for pair in pairs.tolist()}:
            counts[a, b] = counts.get((a, b), 0) + 1
    often = sorted(pair for pair, count in counts.items() if count >= 0.9 * SAMPLES)
    return [(model.body(a).name, model.body(b).name) for a, b in often]


def _false_contacts(model: mujoco.MjModel, chain: ArmChain) -> list[tuple[str, str]]:
    """Find pairs of bodies whose contacts do not indicate a collision: those of the gripper, and structural overlaps.

    Pairs that the model already excludes are omitted.
    """
    hand = [model.body(body).name for body in (chain.last_body, *chain.hand_bodies)]
    pairs = {(a, b) for i, a in enumerate(hand) for b in hand[i + 1 :]}
    pairs |= set(_structural_overlaps(model, chain.joints))
    signatures = {int(signature) for signature in model.exclude_signature}

    def is_known(a: str, b: str) -> bool:
        first, second = sorted((model.body(a).id, model.body(b).id))
        return (first << 16) + second in signatures

    return sorted(pair for pair in pairs if not is_known(*pair))
