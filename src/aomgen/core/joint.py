"""One joint of an articulated object."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array, Vector3, freeze_arrays

JointType = Literal["revolute", "prismatic"]
# Usable share of a joint's range, so that motions do not reach the end stop.
LIMIT_SHARE = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Joint:
    """A revolute or prismatic joint whose axis is positive in the opening (demonstrated) direction.

    Attributes:
        type: "revolute" or "prismatic".
        axis: Unit direction (3,).
        origin: A point on the axis (3,), [m]; for a prismatic joint, any point of the part.
        lower, upper: Range of the joint value, [rad] or [m]; 0 is the closed (scanned) state.

    Example:
        >>> hinge = ag.Joint(type="revolute", axis=(0, 0, 1), origin=(1, 0, 0), lower=0, upper=1.5)
        >>> hinge.motion(np.pi / 2)[:3, 3].round(3).tolist()
        [1.0, -1.0, 0.0]
    """

    type: JointType
    axis: Vector3
    origin: Vector3
    lower: float
    upper: float

    __post_init__ = freeze_arrays

    def motion(self, thetas: ArrayLike) -> Array:
        """Compute the transforms (..., 4, 4) that move the part from joint value 0 to `thetas` (...,), [rad] or [m].

        The transforms are expressed in the frame of axis and origin.
        """
        thetas = np.asarray(thetas, np.float64)
        if self.type == "prismatic":
            return transform(np.eye(3), thetas[..., None] * self.axis)
        R = matrix_from_rotvec(thetas[..., None] * self.axis)
        return transform(R, self.origin - R @ self.origin)

    def move(self, T_to_from: ArrayLike) -> "Joint":
        """Express the joint in another frame, given a rigid transform or similarity (4, 4)."""
        T = np.asarray(T_to_from, np.float64)
        scale = float(np.linalg.norm(T[:3, 0]))
        unit = scale if self.type == "prismatic" else 1.0
        return replace(
            self,
            axis=T[:3, :3] @ self.axis / scale,
            origin=apply(T, self.origin),
            lower=self.lower * unit,
            upper=self.upper * unit,
        )
