"""Prepare a robot for simulation: position servos, pads on its fingers, and no false contacts.

Files come with torque motors, with soft demonstration gains or, as every URDF, without any
actuator. Whether a plan works must not depend on that, so all of them get the same servos, as stiff
and as fast as an arm's own controller.
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

# An arm gives way by 1 cm under 50 N at its end effector, in each joint; the UR5e's model does too, [N/m].
# Joints whose axes pass near the end effector hold like a lever of the second number, [m].
END_STIFFNESS, LEAST_LEVER_M = 5000.0, 0.3
# Stiffness of a joint that slides, [N/m]: 1 kg of load moves it by half a millimetre.
SLIDE_STIFFNESS: Final = 20_000.0
# Rotors and gears keep each servo slower than this, well below the simulation's step rate, [rad/s].
MAX_RATE: Final = 100.0
# Pads press like those of common parallel grippers (20 to 140 N), [N], reached when a share of the stroke is missing.
GRIP_FORCE_N, GRIP_GIVE = 50.0, 0.05
# Random arm configurations from which levers, inertias and overlaps are read.
SAMPLES: Final = 40


def sort_shapes(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Assign the shapes of a robot to the visual and the collision group, and state masses apart from shapes."""
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
    """Add pad boxes, servos and contact exclusions to descriptions of one robot, the last of which compiles fastest.

    The pads approach each other by `pad_way_m` from open to closed. Returns the actuator of the gripper.
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
    """Remove visual geoms and their meshes; this takes fifty times as long once a description has been compiled."""
    for geom in list(spec.geoms):
        if geom.contype == 0 and geom.conaffinity == 0 and geom.group == VISUAL_GROUP:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms if geom.meshname}
    for mesh in list(spec.meshes):
        if (mesh.name or Path(mesh.file).stem) not in used:
            spec.delete(mesh)


def _fix_inertias(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Write every body's mass down, so that shapes may come and go."""
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
    # Rubber: it holds by friction, and gives way a little.
    geom.friction, geom.condim, geom.priority = [0.8, 0.01, 0.0005], 4, 1
    geom.solref, geom.solimp = [0.004, 1.0], [0.95, 0.99, 0.001, 0.5, 2.0]


def _tie_drivers(
    spec: mujoco.MjSpec, model: mujoco.MjModel, strokes: Mapping[str, tuple[float, float]]
) -> None:
    """Let the other driving joints follow the first."""
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
    """Stiffness of the position servo of every arm joint, and the joint's largest inertia."""
    levers, inertias = _levers_and_inertias(model, joints, model.site(ee_site).id)
    slides = [int(model.joint(name).type[0]) == mujoco.mjtJoint.mjJNT_SLIDE for name in joints]
    turning = END_STIFFNESS * np.maximum(levers, LEAST_LEVER_M) ** 2
    stiffness = np.where(slides, SLIDE_STIFFNESS, turning)
    return {name: (float(stiffness[k]), float(inertias[k])) for k, name in enumerate(joints)}


def _add_arm_servos(spec: mujoco.MjSpec, servos: Mapping[str, tuple[float, float]]) -> None:
    """Give every arm joint a critically damped position servo.

    Damping and friction of the file's arm joints are taken to be compensated by the drive.
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
    # Virtual work: the two pads press against each other over the distance that they approach.
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
    """Largest lever (J,) [m] of the end effector about each joint, and largest inertia (J,), over arm configurations."""
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
    """States (count, nq) with the arm anywhere within its limits, from a fixed seed."""
    rng = np.random.default_rng(0)
    states = np.repeat(model.qpos0[None], count, 0)
    for name in joints:
        joint = model.joint(name)
        low, high = joint.range if joint.limited[0] else (-np.pi, np.pi)
        states[:, joint.qposadr[0]] = rng.uniform(max(low, -np.pi), min(high, np.pi), count)
    return states


def _structural_overlaps(model: mujoco.MjModel, joints: tuple[str, ...]) -> list[tuple[str, str]]:
    """Pairs of bodies that touch in nearly every arm configuration: their shapes are rough, the plan is not wrong."""
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
    """Pairs of bodies inside the gripper or of shapes that always overlap; their contacts do not depend on the plan."""
    hand = [model.body(body).name for body in (chain.last_body, *chain.hand_bodies)]
    pairs = {(a, b) for i, a in enumerate(hand) for b in hand[i + 1 :]}
    pairs |= set(_structural_overlaps(model, chain.joints))
    signatures = {int(signature) for signature in model.exclude_signature}

    def is_known(a: str, b: str) -> bool:
        first, second = sorted((model.body(a).id, model.body(b).id))
        return (first << 16) + second in signatures

    return sorted(pair for pair in pairs if not is_known(*pair))
