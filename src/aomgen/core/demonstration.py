"""The recorded demonstration as later stages use it: hand, object and support in the world frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.joint import Joint
from aomgen.core.light import Light
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze


@dataclass(frozen=True, slots=True, kw_only=True)
class Demonstration:
    """What the robot and the object's part did, sampled at a constant rate.

    Attributes:
        times_s: (T,), video clock.
        joints: Arm joints (T, J), [rad].
        gripper: Measured (T,), 0 open .. 1 closed.
        Ts_world_ee: End effector poses (T, 4, 4).
        thetas: Part's joint value (T,), [rad] or [m].
        start_s, end_s: When the part began and ceased to move.
        joint: World frame; 0 is the scanned state, axis positive in the demonstrated direction.
        grasp_ee: Point of the part that the hand holds (3,), end effector frame, [m].
        ee_turn_ratio: Turn of the hand over turn of the part during contact.
    """

    times_s: Array
    joints: Array
    gripper: Array
    Ts_world_ee: Array
    thetas: Array
    start_s: float
    end_s: float
    joint: Joint
    grasp_ee: Array
    ee_turn_ratio: float

    def __post_init__(self) -> None:
        count = len(self.times_s)
        freeze(self, "times_s", self.times_s, (count,))
        freeze(self, "joints", self.joints, (count, None))
        freeze(self, "gripper", self.gripper, (count,))
        freeze(self, "Ts_world_ee", self.Ts_world_ee, (count, 4, 4))
        freeze(self, "thetas", self.thetas, (count,))
        freeze(self, "grasp_ee", self.grasp_ee, (3,))

    @property
    def contact_frames(self) -> NDArray[np.int64]:
        """Indices of the frames during which the part moves."""
        return np.nonzero((self.times_s >= self.start_s - 1e-9) & (self.times_s <= self.end_s + 1e-9))[0]

    @property
    def grasp_path_world(self) -> Array:
        """Held point at every frame (T, 3), [m]."""
        return apply(self.Ts_world_ee, self.grasp_ee[None])


@dataclass(frozen=True, slots=True, kw_only=True)
class SupportPlane:
    """The table: a level plane and the rectangle of it that is known to be there.

    Attributes:
        height: z of the plane, world frame, [m].
        low_xy, high_xy: Corners (2,) of the known rectangle, [m]; -inf and inf where unknown.
    """

    height: float
    low_xy: Array
    high_xy: Array

    def __post_init__(self) -> None:
        freeze(self, "low_xy", self.low_xy, (2,))
        freeze(self, "high_xy", self.high_xy, (2,))


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeScene:
    """What all episodes of a run share.

    Attributes:
        support: The table that objects are put on.
        T_world_plane: Its surface (4, 4), on which shadows fall.
        light: What new objects are lit by.
        light_source: Where the light comes from, in words.
        cameras: Of the episodes' images, world frame, by name.
    """

    support: SupportPlane
    T_world_plane: Array
    light: Light
    light_source: str
    cameras: dict[str, Camera]

    def __post_init__(self) -> None:
        freeze(self, "T_world_plane", self.T_world_plane, (4, 4))


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedObject:
    """Geometry of the recorded object in the scanned state.

    Attributes:
        moving_points_world: Surface of the moving part (N, 3), [m].
        static_points_world: Surface of the static part (M, 3), [m].
        support: What the object stands on.
    """

    moving_points_world: Array
    static_points_world: Array
    support: SupportPlane

    def __post_init__(self) -> None:
        freeze(self, "moving_points_world", self.moving_points_world, (None, 3))
        freeze(self, "static_points_world", self.static_points_world, (None, 3))
