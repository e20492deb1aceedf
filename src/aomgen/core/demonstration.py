"""The recorded demonstration as later stages use it: hand, object and support in the world frame."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.joint import Joint
from aomgen.core.light import Light
from aomgen.core.transforms import apply
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays


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

    times_s: Annotated[Array, "T"]
    joints: Annotated[Array, "T _"]
    gripper: Annotated[Array, "T"]
    Ts_world_ee: Annotated[Array, "T 4 4"]
    thetas: Annotated[Array, "T"]
    start_s: float
    end_s: float
    joint: Joint
    grasp_ee: Vector3
    ee_turn_ratio: float

    __post_init__ = freeze_arrays

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
    low_xy: Annotated[Array, "2"]
    high_xy: Annotated[Array, "2"]

    __post_init__ = freeze_arrays


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
