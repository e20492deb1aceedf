"""A robot and the part that it moves, over time."""

from dataclasses import dataclass, fields, replace
from typing import Annotated, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.values import Array, Matrix4, freeze_arrays


class Kinematics(Protocol):
    """An arm whose end effector poses follow from its joints."""

    def ee_poses(self, joints: ArrayLike) -> Array:
        """Poses (T, 4, 4) at joints (T, J)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """T samples of an arm of J joints, its gripper, and the joint of the object.

    Attributes:
        times_s: (T,), rising, [s].
        joints: Of the arm (T, J), [rad] or [m].
        gripper: (T,), 0 open .. 1 closed.
        thetas: Of the object (T,), [rad] or [m].

    Example:
        >>> path = Trajectory(times_s=[0, 1], joints=[[0.0], [2.0]], gripper=[0, 1], thetas=[0, 0])
        >>> path.at([0.25]).joints.tolist()
        [[0.5]]
        >>> len(path[1:])
        1
    """

    times_s: Annotated[Array, "T"]
    joints: Annotated[Array, "T J"]
    gripper: Annotated[Array, "T"]
    thetas: Annotated[Array, "T"]

    __post_init__ = freeze_arrays

    def __len__(self) -> int:
        return len(self.times_s)

    def __getitem__(self, rows: slice | NDArray[np.int64] | NDArray[np.bool_]) -> Self:
        """Some samples; a value of a derived class keeps what is no array over time."""
        over_time = [field.name for field in fields(self) if _is_over_time(field.type)]
        return replace(self, **{name: getattr(self, name)[rows] for name in over_time})

    def at(self, times_s: ArrayLike) -> "Trajectory":
        """The samples at times (N,), linear between and constant beyond the recorded ones."""
        times = np.asarray(times_s, np.float64)
        columns = np.column_stack([self.joints, self.gripper, self.thetas])
        values = np.stack([np.interp(times, self.times_s, column) for column in columns.T], 1)
        return Trajectory(times_s=times, joints=values[:, :-2], gripper=values[:, -2], thetas=values[:, -1])

    def ee_poses(self, robot: Kinematics) -> Array:
        """End effector poses (T, 4, 4), world frame."""
        return robot.ee_poses(self.joints)


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneTrajectory(Trajectory):
    """A trajectory with the pose (4, 4) at which the object stands, world frame: what an image depends on."""

    T_world_object: Matrix4


def _is_over_time(declared: object) -> bool:
    """Whether a field's annotation says that its first axis is time."""
    return str(next(iter(getattr(declared, "__metadata__", ("",))))).split()[:1] == ["T"]
