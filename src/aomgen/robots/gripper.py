"""Finger joints of a gripper as a function of the gripper value, including couplings and closed kinematic loops.

Forward kinematics does not satisfy loop constraints, so the finger positions are determined once by simulation.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import MalformedFileError
from aomgen.robots.reading import ArmChain

# Number of rows of the table from open to closed; the error of linear interpolation between them is far below a millimeter.
STEPS = 33
# Simulated time in which the fingers come to rest, [s], and the largest constraint error after it, [m] or [rad].
SETTLE_S, MAX_DEVIATION = 0.3, 0.002
# Smallest distance by which the fingers of a gripper approach each other, [m].
MIN_TRAVEL_M = 0.004


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperTable:
    """Positions of the finger joints at increasing gripper values.

    Attributes:
        joint_names: Names of the N finger joints.
        values: Gripper values (K,), from 0 (open) to 1 (closed).
        positions: Joint positions (K, N), [rad] or [m].
    """

    joint_names: Annotated[tuple[str, ...], "N"]
    values: Annotated[Array, "K"]
    positions: Annotated[Array, "K N"]

    __post_init__ = freeze_arrays

    def at(self, gripper: ArrayLike) -> Array:
        """Interpolate the finger joints (T, N) linearly at gripper values (T,); values outside of the table are clipped."""
        values = np.asarray(gripper, np.float64)
        return np.stack([np.interp(values, self.values, column) for column in self.positions.T], -1)


def no_fingers() -> GripperTable:
    """Return the table of an arm without a gripper."""
    return GripperTable(joint_names=(), values=np.zeros(1), positions=np.zeros((1, 0)))


def settle_fingers(
    spec: mujoco.MjSpec, chain: ArmChain, strokes: Mapping[str, tuple[float, float]], path: Path
) -> GripperTable:
    """Simulate the closing of a gripper and record the finger joints.

    The driving joints move from open to closed in equal steps, the arm is fixed, and the other finger joints come to rest
    under the constraints of the model, without gravity, friction and contacts.

    Args:
        spec: Description of the robot; a copy is simulated.
        chain: Joints and bodies of the arm and the gripper.
        strokes: Values of each driving joint at gripper 0 and 1, [rad] or [m].
        path: File of the robot, for messages.

    Raises:
        MalformedFileError: The fingers do not reach the values of a driving joint, or a loop cannot be closed.
    """
    spec = spec.copy()
    spec.option.gravity = np.zeros(3)
    flags = mujoco.mjtDisableBit
    spec.option.disableflags |= int(flags.mjDSBL_CONTACT | flags.mjDSBL_FRICTIONLOSS)
    for name in chain.joints:
        # The arm is fixed at zero, which may be outside its limits.
        spec.joint(name).limited = mujoco.mjtLimited.mjLIMITED_FALSE
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for name in (*strokes, *chain.joints):
        hold = spec.add_equality(name=f"hold_{name}", type=mujoco.mjtEq.mjEQ_JOINT, name1=name)
        # The smallest time constant that is stable at this time step.
        hold.solref, hold.objtype = [0.004, 1.0], mujoco.mjtObj.mjOBJ_JOINT
    model = spec.compile()
    data = mujoco.MjData(model)
    fingers = [model.joint(name).qposadr[0] for name in chain.hand_joints]
    values = np.arange(STEPS) / (STEPS - 1)
    positions = []
    for value in values:
        for name, (start, end) in strokes.items():
            zero = model.qpos0[model.joint(name).qposadr[0]]
            model.eq_data[model.equality(f"hold_{name}").id, 0] = start + value * (end - start) - zero
        mujoco.mj_step(model, data, round(SETTLE_S / model.opt.timestep))
        positions.append(data.qpos[fingers].copy())
        deviation, unit = _find_deviation(model, data)
        if not deviation <= MAX_DEVIATION:
            raise MalformedFileError(
                path,
                f"does not reach the values of gripper.open and .closed, or does not close the loops of the fingers: "
                f"the largest deviation is {deviation:.4f} {unit}, limit {MAX_DEVIATION:g} {unit}",
                "correct these values, or limits and loops of the file",
            )
    return GripperTable(joint_names=chain.hand_joints, values=values, positions=np.array(positions))


def _find_deviation(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[float, str]:
    """Return the largest error of an equality constraint, and its unit."""
    is_equality = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    errors = np.where(is_equality, np.abs(data.efc_pos[: data.nefc]), 0.0)
    row = int(np.argmax(errors))
    constraint = int(data.efc_id[row])
    if model.eq_type[constraint] == mujoco.mjtEq.mjEQ_JOINT:
        is_angle = model.jnt_type[model.eq_obj1id[constraint]] == mujoco.mjtJoint.mjJNT_HINGE
    else:
        # The first three rows of a constraint between bodies are a distance.
        is_angle = row - int(np.argmax(is_equality & (data.efc_id[: data.nefc] == constraint))) >= 3
    return float(errors[row]), "rad" if is_angle else "m"
