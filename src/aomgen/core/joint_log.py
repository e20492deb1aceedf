"""The robot's joint log as a function of time."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.values import Array, freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class JointLog:
    """Arm joints and gripper over the log's own clock.

    Attributes:
        times_s: (T,), strictly increasing, log clock.
        joints: (T, J), [rad], in the order of `joint_names`.
        gripper: (T,), 0 open .. 1 closed.
        joint_names: J names.
    """

    times_s: Annotated[Array, "T"]
    joints: Annotated[Array, "T N"]
    gripper: Annotated[Array, "T"]
    joint_names: Annotated[tuple[str, ...], "N"]

    def __post_init__(self) -> None:
        freeze_arrays(self)
        freeze_arrays(self)

    def at(self, times_s: ArrayLike) -> tuple[Array, Array]:
        """Joints (N, J) and gripper (N,) at log times (N,), linearly interpolated, ends held."""
        times = np.asarray(times_s, np.float64)
        columns = [np.interp(times, self.times_s, column) for column in self.joints.T]
        return np.stack(columns, -1), np.interp(times, self.times_s, self.gripper)

    def shifted(self, offset_s: float) -> "JointLog":
        """The same log on a clock that this one is ahead of by an offset, [s]."""
        return replace(self, times_s=self.times_s - offset_s)

    def covers(self, times_s: ArrayLike) -> NDArray[np.bool_]:
        """Which of the times lie inside the log."""
        times = np.asarray(times_s, np.float64)
        return (times >= self.times_s[0]) & (times <= self.times_s[-1])
