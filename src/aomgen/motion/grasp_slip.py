"""How the hand moves against the part that it moves: it slides along it, and the handle turns in it."""

from dataclasses import dataclass

import numpy as np

from aomgen.core.joint import Joint
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze
from aomgen.motion.ee_path import unwrap_rotations


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspSlip:
    """The hand seen from the part, since one moment; world axes with the part at its scanned place.

    Attributes:
        slips: Displacement of the held point along the part (T, 3), [m].
        pivots: Turn of the hand against the part (T, 3), rotation vectors, [rad].
    """

    slips: Array
    pivots: Array

    def __post_init__(self) -> None:
        freeze(self, "slips", self.slips, (None, 3))
        freeze(self, "pivots", self.pivots, (len(self.slips), 3))

    @property
    def slip_m(self) -> Array:
        """Distance (T,) that the held point is from where it was, [m]."""
        return np.linalg.norm(self.slips, axis=1)

    @property
    def pivot_rad(self) -> Array:
        """Angle (T,) by which the hand has turned, [rad]."""
        return np.linalg.norm(self.pivots, axis=1)


def measure_slip(
    joint: Joint, thetas: Array, Ts_world_ee: Array, grasp_ee: Array, reference: int
) -> GraspSlip:
    """Slip and pivot of the hand against the part; zero at the reference.

    Args:
        joint: Value 0 is the scanned place, world frame.
        thetas: Joint values (T,), [rad] or [m].
        Ts_world_ee: End-effector poses (T, 4, 4) at the same times, in the order of time.
        grasp_ee: Held point (3,), end-effector frame, [m].
        reference: Index of the moment that slip and pivot are told from.

    Source: DESIGN.md, section 4, "Joint value". Not checked: that the hand touches the part; values
    are only as independent of the hand's path as `thetas` are.
    """
    Ts_part_ee = invert(joint.motion(thetas)) @ Ts_world_ee
    points = apply(Ts_part_ee, grasp_ee)
    rotations = Ts_part_ee[:, :3, :3]
    turns = rotations @ rotations[reference].T
    forwards = unwrap_rotations(turns[reference:])
    backwards = unwrap_rotations(turns[reference::-1])
    return GraspSlip(slips=points - points[reference], pivots=np.concatenate([backwards[:0:-1], forwards]))
