"""Position servos for robot files: what an arm's own controller does, as stiff and as fast.

Files come with torque motors, with soft demonstration gains or, as every URDF, without any
actuator. Whether a plan works must not depend on that, so every file robot gets the same servos.
"""

from collections.abc import Sequence
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array

# An arm gives way by 1 cm under 50 N at its end effector, in each joint; the UR5e's model does too, [N/m].
END_STIFFNESS: Final = 5000.0
# Joints whose axes pass near the end effector hold like this far lever, [m].
LEAST_LEVER_M: Final = 0.3
# Stiffness of a joint that slides, [N/m]: 1 kg of load moves it by half a millimetre.
SLIDE_STIFFNESS: Final = 20_000.0
# Rotors and gears keep each servo slower than this, well below the simulation's step rate, [rad/s].
MAX_RATE: Final = 100.0
# Pads press like those of common parallel grippers (20 to 140 N), [N].
GRIP_FORCE_N: Final = 50.0
# The force is reached when this share of the stroke is missing.
GRIP_GIVE: Final = 0.05
# Random arm configurations from which levers, inertias and overlaps are read.
SAMPLES: Final = 40


def add_arm_servos(
    specs: Sequence[mujoco.MjSpec], model: mujoco.MjModel, joints: tuple[str, ...], ee_site: str
) -> None:
    """Give every arm joint a critically damped position servo.

    Damping and friction of the file's arm joints are taken to be compensated by the drive.

    Args:
        specs: Descriptions of one robot; all get the same.
        model: The robot.
        joints: Names of the arm joints.
        ee_site: End effector.
    """
    levers, inertias = _levers_and_inertias(model, joints, model.site(ee_site).id)
    for name, lever, inertia in zip(joints, levers, inertias, strict=True):
        slides = int(model.joint(name).type[0]) == mujoco.mjtJoint.mjJNT_SLIDE
        kp = SLIDE_STIFFNESS if slides else END_STIFFNESS * max(lever, LEAST_LEVER_M) ** 2
        mass = max(inertia, kp / MAX_RATE**2)
        for spec in specs:
            joint = spec.joint(name)
            joint.damping, joint.frictionloss = np.zeros(3), 0.0
            joint.armature = max(joint.armature, kp / MAX_RATE**2 - inertia)
            _servo(spec, f"servo_{name}", name, kp, 2.0 * np.sqrt(kp * mass), np.inf)


def add_grip_servo(specs: Sequence[mujoco.MjSpec], driver: str, stroke: float, pad_way_m: float) -> str:
    """Close a hand through one joint; the name of the actuator.

    Args:
        specs: Descriptions of one robot; all get the same.
        driver: The joint.
        stroke: Its way from open to closed, [rad] or [m].
        pad_way_m: How much nearer the pads come on that way, [m].
    """
    # Virtual work: the two pads press against each other over the way that they come nearer.
    force = GRIP_FORCE_N * pad_way_m / abs(stroke)
    kp = force / (GRIP_GIVE * abs(stroke))
    name = f"servo_{driver}"
    for spec in specs:
        joint = spec.joint(driver)
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.armature = max(joint.armature, kp / MAX_RATE**2)
        _servo(spec, name, driver, kp, 2.0 * np.sqrt(kp * joint.armature), force)
    return name


def _servo(spec: mujoco.MjSpec, name: str, joint: str, kp: float, kv: float, limit: float) -> None:
    gain, bias = np.zeros(10), np.zeros(10)
    gain[0], bias[1], bias[2] = kp, -kp, -kv
    actuator = spec.add_actuator(
        name=name,
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


def _levers_and_inertias(model: mujoco.MjModel, joints: tuple[str, ...], site: int) -> tuple[Array, Array]:
    """Largest lever (J,) [m] of the end effector about each joint, and largest inertia (J,), over arm configurations."""
    data = mujoco.MjData(model)
    dofs = np.array([model.joint(name).dofadr[0] for name in joints])
    levers, inertias = np.zeros(len(joints)), np.zeros(len(joints))
    full = np.zeros((model.nv, model.nv))
    jacobian = np.zeros((3, model.nv))
    for qpos in sample_configurations(model, joints, SAMPLES):
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        mujoco.mj_jacSite(model, data, jacobian, None, site)
        levers = np.maximum(levers, np.linalg.norm(jacobian[:, dofs], axis=0))
        inertias = np.maximum(inertias, np.diag(full)[dofs])
    return levers, inertias


def sample_configurations(model: mujoco.MjModel, joints: tuple[str, ...], count: int) -> Array:
    """States (count, nq) with the arm anywhere within its limits, from a fixed seed."""
    rng = np.random.default_rng(0)
    states = np.repeat(model.qpos0[None], count, 0)
    for name in joints:
        joint = model.joint(name)
        low, high = joint.range if joint.limited[0] else (-np.pi, np.pi)
        states[:, joint.qposadr[0]] = rng.uniform(max(low, -np.pi), min(high, np.pi), count)
    return states


def structural_overlaps(model: mujoco.MjModel, joints: tuple[str, ...]) -> list[tuple[str, str]]:
    """Pairs of bodies that touch in nearly every arm configuration: their shapes are rough, the plan is not wrong."""
    data = mujoco.MjData(model)
    counts: dict[tuple[int, int], int] = {}
    for qpos in sample_configurations(model, joints, SAMPLES):
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
