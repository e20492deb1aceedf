"""Trajectories of arm and object, and the recorded demonstration with its object and support, in the world frame."""

from dataclasses import dataclass, fields, replace
from typing import Annotated, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.boxes import OrientedBox
from aomgen.core.camera import Camera
from aomgen.core.joint import Joint
from aomgen.core.light import Light
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays

# Smallest change of the gripper value that counts as a grasp; fingers that reach under a lid close only a little.
MIN_GRASP = 0.05
# A gripper with a value below this counts as open.
OPEN = 0.03


class Kinematics(Protocol):
    """An arm with forward kinematics."""

    def ee_poses(self, joints: ArrayLike) -> Array:
        """Compute poses (T, 4, 4) at joints (T, J)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """T samples of an arm of J joints, its gripper, and the joint of the object.

    Attributes:
        times_s: Times (T,), increasing, [s].
        joints: Arm joints (T, J), [rad] or [m].
        gripper: Gripper (T,), 0 open .. 1 closed.
        thetas: Joint values of the object (T,), [rad] or [m].

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
        """Select samples; fields of derived classes that are not arrays over time are kept."""
        over_time = [field.name for field in fields(self) if _is_over_time(field.type)]
        return replace(self, **{name: getattr(self, name)[rows] for name in over_time})

    def at(self, times_s: ArrayLike) -> "Trajectory":
        """Interpolate the samples linearly at times (N,), [s]; before the first and after the last sample they are constant."""
        times = np.asarray(times_s, np.float64)
        columns = np.column_stack([self.joints, self.gripper, self.thetas])
        values = np.stack([np.interp(times, self.times_s, column) for column in columns.T], 1)
        return Trajectory(times_s=times, joints=values[:, :-2], gripper=values[:, -2], thetas=values[:, -1])

    def ee_poses(self, robot: Kinematics) -> Array:
        """Compute the end-effector poses (T, 4, 4), world frame."""
        return robot.ee_poses(self.joints)

    def with_object(self, T_world_object: ArrayLike) -> "SceneTrajectory":
        """Return the samples with the pose (4, 4) of the object, world frame."""
        samples = {item.name: getattr(self, item.name) for item in fields(Trajectory)}
        return SceneTrajectory(**samples, T_world_object=np.asarray(T_world_object, np.float64))


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneTrajectory(Trajectory):
    """A trajectory with the object's pose (4, 4), world frame; together they determine the images of a camera."""

    T_world_object: Matrix4


def _is_over_time(declared: object) -> bool:
    """Return whether a field's annotation marks its first axis as time."""
    return str(next(iter(getattr(declared, "__metadata__", ("",))))).split()[:1] == ["T"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Demonstration(Trajectory):
    """Recorded motion of the robot and of the object's moving part, sampled at a constant rate on the video's clock.

    Attributes:
        Ts_world_ee: End-effector poses (T, 4, 4).
        start_s, end_s: Times at which the part starts and stops moving, [s].
        joint: Joint, world frame; value 0 is the scanned state, and the axis is positive in the demonstrated direction.
        grasp_ee: Grasp point on the part (3,), end-effector frame, [m].
        ee_turn_ratio: Ratio of the end effector's rotation to that of the part during contact.
    """

    Ts_world_ee: Annotated[Array, "T 4 4"]
    start_s: float
    end_s: float
    joint: Joint
    grasp_ee: Vector3
    ee_turn_ratio: float

    @property
    def contact_frames(self) -> NDArray[np.int64]:
        """Indices of the frames during which the part moves."""
        return np.nonzero((self.times_s >= self.start_s - 1e-9) & (self.times_s <= self.end_s + 1e-9))[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Times of the events of a demonstration, [s] from its first sample.

    Attributes:
        close: Time at which the gripper starts to close.
        start, end: Times at which the part starts and stops moving.
        free: Time at which the gripper is open again.
        last: End of the demonstration.
    """

    close: float
    start: float
    end: float
    free: float
    last: float

    @property
    def marks(self) -> Array:
        """All times in order (6,), beginning with 0."""
        return np.array([0.0, self.close, self.start, self.end, self.free, self.last])


def gripper_command(demo: Demonstration, opened_most: float = 1.0) -> Array:
    """Compute the gripper command (T,), 0 open .. 1 closed, from the measured gripper values.

    A gripper that holds a bar stalls before it is fully closed, so the value at which it stalls is mapped to 1. The initial
    value is kept, or replaced by `opened_most` if that is smaller (more open). Without a grasp, the measured values are
    returned.
    """
    opened, share = _closing(demo)
    if opened is None:
        return share
    opened = min(opened, opened_most)
    return opened + (1.0 - opened) * share


def _closing(demo: Demonstration) -> tuple[float | None, Array]:
    """Return the gripper's initial value, and its progress (T,), 0..1, from there to the value at which it holds.

    Without a grasp, the results are None and the measured values.
    """
    contact = demo.contact_frames
    hold, opened = float(np.median(demo.gripper[contact])), float(np.min(demo.gripper[: contact[0] + 1]))
    if not hold - opened >= MIN_GRASP:
        return None, demo.gripper
    share = (demo.gripper - opened) / (0.95 * (hold - opened))
    return opened if opened > OPEN else 0.0, np.where(share < 0.03, 0.0, np.clip(share, 0.0, 1.0))


def timing(demo: Demonstration) -> Timing:
    """Find the times at which the gripper closes and opens, and at which the part starts and stops moving."""
    times = demo.times_s - demo.times_s[0]
    _, share = _closing(demo)
    start, end = demo.start_s - demo.times_s[0], demo.end_s - demo.times_s[0]
    close, free = start, end
    if share.max() > 0.5 and share.min() < 0.05:
        open_before = np.flatnonzero((times <= start) & (share < 0.05))
        open_after = np.flatnonzero((times >= end) & (share < 0.15))
        close = float(times[open_before[-1]]) if len(open_before) else 0.0
        free = float(times[open_after[0]]) if len(open_after) else float(times[-1])
    return Timing(close=close, start=start, end=end, free=free, last=float(times[-1]))


@dataclass(frozen=True, slots=True, kw_only=True)
class SupportPlane:
    """The table: a horizontal plane, and the rectangle of known extent.

    Attributes:
        height: z of the plane, world frame, [m].
        low_xy, high_xy: Lower and upper corner (2,) of the rectangle, world frame, [m]; -inf and inf for unknown sides.
    """

    height: float
    low_xy: Annotated[Array, "2"]
    high_xy: Annotated[Array, "2"]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeScene:
    """Scene that all episodes of a run share.

    Attributes:
        support: Table on which the objects stand.
        obstacles: Other objects within the robot's reach.
        T_world_plane: Pose of the table's surface (4, 4), on which shadows are cast.
        light: Light on new objects.
        light_source: Description of the light's origin.
        cameras: Cameras of the episodes' images, world frame, by name.
    """

    support: SupportPlane
    obstacles: tuple[OrientedBox, ...]
    T_world_plane: Matrix4
    light: Light
    light_source: str
    cameras: dict[str, Camera]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedObject:
    """Geometry of the recorded object in the scanned state.

    Attributes:
        moving_points_world: Surface of the moving part (N, 3), [m].
        static_points_world: Surface of the static part (M, 3), [m].
        support: The table under the object.
    """

    moving_points_world: Annotated[Array, "_ 3"]
    static_points_world: Annotated[Array, "_ 3"]
    support: SupportPlane

    __post_init__ = freeze_arrays
