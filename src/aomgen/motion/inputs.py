"""What AOMotion looks at: a video of the demonstration, the object as scanned, and the hand by the robot's log."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.alignment import Clock
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.parts import spread_points, surface_points
from aomgen.core.recording import JointLog
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.io.video import Video
from aomgen.robots.gripper_surface import hand_surface
from aomgen.robots.robot import FingerPad, RobotModel

# Points along either side of a pad's face: pads are some 2 cm long, so 2 to 3 mm apart, as points of the part.
_PAD_GRID = 9
# Speeds are differences over this time, [s]: ten rows of a 100 Hz log, so that its noise averages out.
_SPEED_WINDOW_S = 0.1
# A gripper that moves less than this share of its stroke tells nothing about grasp and release.
_MIN_STROKE = 0.15
# Fingers farther away than this touch or grasp something else, whatever the alignment's error, [m].
NEAR_M = 0.10
# A gripper that closes beyond this holds nothing: its pads meet at about 0.97, and 3 mm keep them from it.
EMPTY_GRIP = 0.96
# Fingers this much farther away than at their nearest count as touching, [m].
_NEAR_TOUCH_M = 0.01
# Length of the still stretches at the beginning and the end of a touch, [s].
REST_S = 0.25
# Every so many points of the hand's surface tell its distance, 1 cm apart.
_EVERY = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionInput:
    """What AOMotion looks at, world frame.

    Attributes:
        video, camera: Of the fixed camera.
        log: The robot's joint log on the video's clock.
        scene: As scanned.
        labels: Part label of every Gaussian of the scene, see `conventions`.
        clock: How the log was brought to the video's clock.
    """

    video: Video
    camera: Camera
    log: JointLog
    robot: RobotModel
    scene: Annotated[Gaussians, "N"]
    labels: Annotated[NDArray[np.uint8], "N"]
    clock: Clock

    __post_init__ = freeze_arrays

    def ee_poses_at(self, times_s: ArrayLike) -> Array:
        """End-effector poses (T, 4, 4), world frame, at video times (T,)."""
        return np.asarray(self.robot.ee_poses(self.log.at(times_s)[0]), np.float64)

    def body_poses_at(self, times_s: ArrayLike) -> Array:
        """Poses (T, B, 4, 4) of the robot's bodies, world frame, at video times (T,)."""
        return self.robot.link_poses(*self.log.at(times_s))

    @property
    def points_moving(self) -> Array:
        """Points of the moving part at its scanned place (N, 3), world frame, [m]."""
        return surface_points(self.scene, self.labels, MOVING)

    @property
    def points_static(self) -> Array:
        """Points of the standing part (M, 3), world frame, [m]."""
        return surface_points(self.scene, self.labels, STATIC)

    @property
    def points_other(self) -> Array:
        """Points of everything else but the robot (K, 3), world frame, [m]."""
        return surface_points(self.scene, self.labels, BACKGROUND)

    def surface_moving(self, spacing_m: float) -> Array:
        """Points of the moving part (N, 3) that leave no gaps along thin things, world frame, [m]."""
        return spread_points(self.scene, self.labels, MOVING, spacing_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperSignals:
    """The hand over video times.

    Attributes:
        gripper: 0 open .. 1 closed.
        distances_m: Smallest distance of a finger pad to the part at its scanned place, [m].
    """

    times_s: Annotated[Array, "T"]
    Ts_world_ee: Annotated[Array, "T 4 4"]
    speeds_m_s: Annotated[Array, "T"]
    gripper: Annotated[Array, "T"]
    distances_m: Annotated[Array, "T"]

    __post_init__ = freeze_arrays


def read_gripper_signals(demo: MotionInput, times_s: Array) -> GripperSignals:
    """The hand and its distance to the moving part at video times (T,)."""
    before, after = (demo.ee_poses_at(times_s + side * _SPEED_WINDOW_S / 2)[:, :3, 3] for side in (-1, 1))
    return GripperSignals(
        times_s=times_s,
        Ts_world_ee=demo.ee_poses_at(times_s),
        speeds_m_s=np.linalg.norm(after - before, axis=1) / _SPEED_WINDOW_S,
        gripper=demo.log.at(times_s)[1],
        distances_m=measure_pad_distances(demo, demo.points_moving, times_s),
    )


def measure_pad_distances(demo: MotionInput, points: Array, times_s: Array) -> Array:
    """Smallest distance (T,) of a finger pad, or of the end effector without pads, to points (N, 3), [m]."""
    if demo.robot.pads:
        bodies = demo.body_poses_at(times_s)
        faces = [apply(bodies[:, None, pad.body], _sample_face(pad)) for pad in demo.robot.pads]
        posed = np.concatenate(faces, axis=1)
    else:
        posed = demo.ee_poses_at(times_s)[:, None, :3, 3]
    return cKDTree(points).query(posed.reshape(-1, 3))[0].reshape(len(times_s), -1).min(1)


def _sample_face(pad: FingerPad) -> Array:
    """Even points (G, 3) on the pad's inner face, body frame, [m]."""
    steps = np.linspace(-1, 1, _PAD_GRID)
    grid = np.stack(np.meshgrid(steps, steps, [1.0]), -1).reshape(-1, 3)
    return apply(pad.T_body_pad, grid * pad.half_extents)


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchInterval:
    """Frames between which the hand can move the part.

    Attributes:
        first, last: Frame indices, both inside.
        gripped: The gripper closed on the part at `first` and opened after `last`; else only the
            distance speaks, and neither end is sharp.
    """

    first: int
    last: int
    gripped: bool

    @property
    def frames(self) -> slice:
        """All of them."""
        return slice(self.first, self.last + 1)


def find_touch(signals: GripperSignals) -> TouchInterval:
    """When the hand can move the part.

    A gripper that closes near the part, and not upon itself, says it best; to where it opens again or
    the video ends. One that hardly moves or is closed (a hook, a push) leaves the distance: from the first
    frame at which the fingers are about as near as they ever come, to the end.
    """
    grip, distances = signals.gripper, signals.distances_m
    stroke = float(grip.max() - grip.min())
    if stroke >= _MIN_STROKE:
        closed = np.flatnonzero(grip > (grip.max() + grip.min()) / 2)
        closed = np.split(closed, np.flatnonzero(np.diff(closed) > 1) + 1)
        grasps = [_plateau(run, grip, 0.1 * stroke) for run in closed if np.median(grip[run]) < EMPTY_GRIP]
        grasps = [(first, last) for first, last in grasps if distances[first] <= NEAR_M and last > first]
        if grasps:
            first, last = min(grasps, key=lambda grasp: distances[grasp[0]])
            return TouchInterval(first=first, last=last, gripped=True)
    near = distances <= float(distances.min()) + _NEAR_TOUCH_M
    return TouchInterval(first=int(np.argmax(near)), last=len(grip) - 1, gripped=False)


def refine_touch(touch: TouchInterval, times_s: Array, gaps_m: Array) -> TouchInterval:
    """The touch of a hand that grips nothing, by the distance of its whole surface.

    Knuckles and backs of fingers push as well as pads. It begins a moment before the surface is about as
    near as it ever comes, so that its first frames show the part at rest.

    Args:
        touch: From `find_touch`.
        times_s: Of the frames (T,).
        gaps_m: From `measure_surface_gaps` (T,).
    """
    near = int(np.argmax(gaps_m <= float(gaps_m.min()) + _NEAR_TOUCH_M))
    return replace(touch, first=int(np.searchsorted(times_s, times_s[near] - REST_S)))


def measure_surface_gaps(demo: MotionInput, times_s: Array) -> Array:
    """Smallest distance (T,) of the hand's surface to the part at its scanned place, [m]; infinite without meshes."""
    surface, tree = hand_surface(demo.robot), cKDTree(demo.points_moving)
    placed = (surface.pose(Ts)[0][::_EVERY] for Ts in demo.body_poses_at(times_s))
    return np.array([tree.query(points)[0].min(initial=np.inf) for points in placed])


def _plateau(run: NDArray[np.intp], grip: Array, tolerance: float) -> tuple[int, int]:
    """Frames of a run in which the grip stays at its usual value."""
    steady = run[np.abs(grip[run] - np.median(grip[run])) <= tolerance]
    return int(steady[0]), int(steady[-1])
