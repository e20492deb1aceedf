"""All finger joints of a gripper over its opening value, couplings and closed loops included.

Forward kinematics alone leaves loops open, so the fingers settle once in simulation.
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

# Rows of the table from open to closed; between them positions are linear to far below a millimetre.
STEPS = 33
# Time in which the held joints come to rest, [s]; a loop or stroke that is farther open after it is refused, [m] or [rad].
SETTLE_S, OPEN_LOOP_M = 0.3, 0.002
# Fingers that come less than this nearer are no gripper, [m].
MIN_TRAVEL_M = 0.004


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperTable:
    """Positions of the N finger joints, [rad] or [m], settled at increasing gripper values."""

    joint_names: Annotated[tuple[str, ...], "N"]
    values: Annotated[Array, "K"]
    positions: Annotated[Array, "K N"]

    __post_init__ = freeze_arrays

    def at(self, gripper: ArrayLike) -> Array:
        """Finger joints (T, F) for gripper values (T,), linear between rows, ends held."""
        values = np.asarray(gripper, np.float64)
        return np.stack([np.interp(values, self.values, column) for column in self.positions.T], -1)


def no_fingers() -> GripperTable:
    """The table of an arm without a gripper."""
    return GripperTable(joint_names=(), values=np.zeros(1), positions=np.zeros((1, 0)))


def settle_fingers(
    spec: mujoco.MjSpec, chain: ArmChain, strokes: Mapping[str, tuple[float, float]], path: Path
) -> GripperTable:
    """Move the driving joints evenly from open to closed; the rest settles, without gravity and contacts.

    The arm is held. `strokes` are the driving joints' values at gripper 0 and 1, [rad] or [m].

    Raises:
        MalformedFileError: A loop cannot be closed, or a stroke leads out of the limits.
    """
    spec = spec.copy()
    spec.option.gravity = np.zeros(3)
    flags = mujoco.mjtDisableBit
    spec.option.disableflags |= int(flags.mjDSBL_CONTACT | flags.mjDSBL_FRICTIONLOSS)
    for name in chain.joints:
        # The zero at which the arm is held may lie outside its limits.
        spec.joint(name).limited = mujoco.mjtLimited.mjLIMITED_FALSE
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for name in (*strokes, *chain.joints):
        hold = spec.add_equality(name=f"hold_{name}", type=mujoco.mjtEq.mjEQ_JOINT, name1=name)
        # As stiff as the time step allows.
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
        loops = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        apart = float(np.abs(data.efc_pos[: data.nefc][loops]).max(initial=0.0))
        if not apart <= OPEN_LOOP_M:
            raise MalformedFileError(
                path,
                f"does not reach the values of gripper.open and .closed, or does not close the loops of the fingers: "
                f"the deviation is {1000 * apart:.1f} mm, limit {1000 * OPEN_LOOP_M:.0f} mm",
                "correct these values, or limits and loops of the file",
            )
    return GripperTable(joint_names=chain.hand_joints, values=values, positions=np.array(positions))
