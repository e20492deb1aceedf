"""The recorded demonstration as later stages use it: hand, object and support in the world frame."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.core.boxes import OrientedBox
from aomgen.core.camera import Camera
from aomgen.core.joint import Joint
from aomgen.core.light import Light
from aomgen.core.trajectory import Trajectory
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays

# Smallest change of the gripper that is a grasp: fingers that reach under a lid are hardly open before.
MIN_GRASP = 0.05
# A gripper that measures less than this counts as open.
OPEN = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class Demonstration(Trajectory):
    """What the robot and the object's part did, sampled at a constant rate; times are on the video's clock.

    Attributes:
        Ts_world_ee: End effector poses (T, 4, 4).
        start_s, end_s: When the part began and ceased to move.
        joint: World frame; 0 is the scanned state, axis positive in the demonstrated direction.
        grasp_ee: Point of the part that the hand holds (3,), end effector frame, [m].
        ee_turn_ratio: Turn of the hand over turn of the part during contact.
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
    """Moments of the demonstration, [s] from its first sample.

    Attributes:
        close: The gripper begins to close.
        start, end: The part begins and ceases to move.
        free: The gripper is open again.
        last: The demonstration ends.
    """

    close: float
    start: float
    end: float
    free: float
    last: float

    @property
    def marks(self) -> Array:
        """All moments in order (6,), 0 first."""
        return np.array([0.0, self.close, self.start, self.end, self.free, self.last])


def gripper_command(demo: Demonstration, opened_most: float = 1.0) -> Array:
    """The command of the gripper (T,), 0..1, from what was measured.

    A gripper that holds a bar stalls before it is closed, so the level it stalls at counts as
    1; the level it comes with stays, or is `opened_most` where that is more open. A demonstration that closes nothing
    keeps what was measured.
    """
    opened, share = _closing(demo)
    if opened is None:
        return share
    opened = min(opened, opened_most)
    return opened + (1.0 - opened) * share


def _closing(demo: Demonstration) -> tuple[float | None, Array]:
    """Level at which the gripper comes, and how far it is from there to its hold (T,), 0..1.

    None, and what was measured, where nothing is closed.
    """
    contact = demo.contact_frames
    hold, opened = float(np.median(demo.gripper[contact])), float(np.min(demo.gripper[: contact[0] + 1]))
    if not hold - opened >= MIN_GRASP:
        return None, demo.gripper
    share = (demo.gripper - opened) / (0.95 * (hold - opened))
    return opened if opened > OPEN else 0.0, np.where(share < 0.03, 0.0, np.clip(share, 0.0, 1.0))


def timing(demo: Demonstration) -> Timing:
    """When the hand closes, pulls, opens and leaves."""
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
    """The table: a level plane and the rectangle of it that is known to be there.

    Attributes:
        height: z of the plane, world frame, [m].
        low_xy, high_xy: Corners (2,) of the known rectangle, [m]; -inf and inf where unknown.
    """

    height: float
    low_xy: Annotated[Array, "2"]
    high_xy: Annotated[Array, "2"]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeScene:
    """What all episodes of a run share.

    Attributes:
        support: The table that objects are put on.
        obstacles: What else stands within the robot's reach.
        T_world_plane: Its surface (4, 4), on which shadows fall.
        light: What new objects are lit by.
        light_source: Where the light comes from, in words.
        cameras: Of the episodes' images, world frame, by name.
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
        support: What the object stands on.
    """

    moving_points_world: Annotated[Array, "_ 3"]
    static_points_world: Annotated[Array, "_ 3"]
    support: SupportPlane

    __post_init__ = freeze_arrays
