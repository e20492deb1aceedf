"""Finger joints of a gripper with closed loops, as a table over its opening value.

Forward kinematics alone leaves such loops open, so the fingers are settled once in simulation.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.values import Array, freeze
from aomgen.errors import MalformedFileError
from aomgen.robots.robot_files import RobotFiles, set_options

# Rows of the table from open to closed; between them positions are linear to far below a millimetre.
STEPS = 33
# Time in which the fingers come to rest at each step, [s].
SETTLE_S = 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperTable:
    """Settled finger joints.

    Attributes:
        joint_names: The F finger joints.
        values: (K,), increasing gripper values.
        positions: (K, F), [rad] or [m].
    """

    joint_names: tuple[str, ...]
    values: Array
    positions: Array

    def __post_init__(self) -> None:
        freeze(self, "values", self.values, (None,))
        freeze(self, "positions", self.positions, (len(self.values), len(self.joint_names)))

    def at(self, gripper: ArrayLike) -> Array:
        """Finger joints (T, F) for gripper values (T,), linear between rows, ends held."""
        values = np.asarray(gripper, np.float64)
        return np.stack([np.interp(values, self.values, column) for column in self.positions.T], -1)


def no_fingers() -> GripperTable:
    """The table of an arm without a gripper."""
    return GripperTable(joint_names=(), values=np.zeros(1), positions=np.zeros((1, 0)))


def simulate_finger_table(files: RobotFiles) -> GripperTable:
    """Close the gripper slowly in simulation and record where its joints settle.

    The table is indexed by the measured driver angle, as the joint log is. Gravity is off: the
    fingers of a stiff gripper do not sag measurably.

    Raises:
        MalformedFileError: The gripper does not move when its actuator is driven.
    """
    spec = mujoco.MjSpec.from_file(str(files.gripper))
    set_options(spec)
    spec.option.gravity = np.zeros(3)
    model = spec.compile()
    # The pads stop each other just short of the last driver angle; alone in the air that matters to nobody.
    model.geom_contype[:], model.geom_conaffinity[:] = 0, 0
    data = mujoco.MjData(model)
    strip = len(files.prefix)
    driver = model.joint(files.driver[0][strip:]).qposadr[0]
    actuator = model.actuator(files.actuator[0][strip:]).id
    names = [model.joint(j).name for j in range(model.njnt)]
    rows = []
    for control in np.linspace(0.0, files.actuator[1], STEPS):
        data.ctrl[actuator] = control
        for _ in range(int(SETTLE_S / model.opt.timestep)):
            mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
    positions = np.array(rows)
    values = positions[:, driver] / files.driver[1]
    if not np.all(np.diff(values) > 0) or not values[-1] > 0.9:
        raise MalformedFileError(
            files.gripper, f"closes to {values[-1]:.2f} of its stroke, want 0.9 or more", "check its actuator"
        )
    return GripperTable(
        joint_names=tuple(files.prefix + name for name in names), values=values, positions=positions
    )
