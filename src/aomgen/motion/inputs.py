"""Inputs of AOMotion: a video of the demonstration, the scanned object, and the gripper by the joint log."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.alignment import Clock
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.parts import surface_points
from aomgen.core.recording import JointLog
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.io.video import Video
from aomgen.robots.gripper_surface import hand_surface
from aomgen.robots.robot import FingerPad, RobotModel

# Points along either side of a pad's face: pads are about 2 cm long, so points are 2 to 3 mm
# apart, as on the part.
_PAD_GRID = 9
# Speeds are differences over this time, [s]: ten rows of a 100 Hz log, so that its noise averages out.
_SPEED_WINDOW_S = 0.1
# A gripper that moves less than this share of its stroke does not show grasp and release.
_MIN_STROKE = 0.15
# Fingers farther away than this touch or grasp something else, whatever the error of the alignment, [m].
NEAR_M = 0.10
# A gripper that closes beyond this holds nothing: its pads meet at about 0.97, and 3 mm of
# material stop them before it.
EMPTY_GRIP = 0.96
# Fingers this much farther away than at their nearest count as touching, [m].
_NEAR_TOUCH_M = 0.01
# Length of the still stretches at the beginning and the end of a touch, [s].
REST_S = 0.25
# One of this many points of the gripper's surface is used to measure distances; they are 1 cm apart.
_EVERY = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionInput:
    """Inputs of AOMotion, world frame.

    Attributes:
        video, camera: Video of the fixed camera, and its calibration.
        log: The robot's joint log on the video's clock.
        scene: Gaussians as scanned.
        labels: Part label of every Gaussian of the scene, see `conventions`.
        clock: Mapping of the log's clock to the video's.
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
        """Compute end-effector poses (T, 4, 4), world frame, at video times (T,)."""
        return np.asarray(self.robot.ee_poses(self.log.at(times_s)[0]), np.float64)

    def body_poses_at(self, times_s: ArrayLike) -> Array:
        """Compute poses (T, B, 4, 4) of the robot's bodies, world frame, at video times (T,)."""
        return self.robot.link_poses(*self.log.at(times_s))

    @property
    def points_moving(self) -> Array:
        """Points of the moving part at its scanned pose (N, 3), world frame, [m]."""
        return surface_points(self.scene, self.labels, MOVING)

    @property
    def points_static(self) -> Array:
        """Points of the static part (M, 3), world frame, [m]."""
        return surface_points(self.scene, self.labels, STATIC)

    @property
    def points_other(self) -> Array:
        """Points of everything else but the robot (K, 3), world frame, [m]."""
        return surface_points(self.scene, self.labels, BACKGROUND)


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperSignals:
    """Signals of the gripper over video times.

    Attributes:
        gripper: 0 open .. 1 closed.
        distances_m: Smallest distance of a finger pad to the part at its scanned pose, [m].
    """

    times_s: Annotated[Array, "T"]
    Ts_world_ee: Annotated[Array, "T 4 4"]
    speeds_m_s: Annotated[Array, "T"]
    gripper: Annotated[Array, "T"]
    distances_m: Annotated[Array, "T"]

    __post_init__ = freeze_arrays


def read_gripper_signals(demo: MotionInput, times_s: Array) -> GripperSignals:
    """Read the gripper's signals and its distance to the moving part at video times (T,)."""
    before, after = (demo.ee_poses_at(times_s + side * _SPEED_WINDOW_S / 2)[:, :3, 3] for side in (-1, 1))
    return GripperSignals(
        times_s=times_s,
        Ts_world_ee=demo.ee_poses_at(times_s),
        speeds_m_s=np.linalg.norm(after - before, axis=1) / _SPEED_WINDOW_S,
        gripper=demo.log.at(times_s)[1],
        distances_m=measure_pad_distances(demo, demo.points_moving, times_s),
    )


def measure_pad_distances(demo: MotionInput, points: Array, times_s: Array) -> Array:
    """Measure the smallest distance (T,) of a pad, or else of the end effector, to points (N, 3), [m]."""
    if demo.robot.pads:
        bodies = demo.body_poses_at(times_s)
        faces = [apply(bodies[:, None, pad.body], _sample_face(pad)) for pad in demo.robot.pads]
        posed = np.concatenate(faces, axis=1)
    else:
        posed = demo.ee_poses_at(times_s)[:, None, :3, 3]
    return cKDTree(points).query(posed.reshape(-1, 3))[0].reshape(len(times_s), -1).min(1)


def _sample_face(pad: FingerPad) -> Array:
    """Sample an even grid (G, 3) on the pad's inner face, body frame, [m]."""
    steps = np.linspace(-1, 1, _PAD_GRID)
    grid = np.stack(np.meshgrid(steps, steps, [1.0]), -1).reshape(-1, 3)
    return apply(pad.T_body_pad, grid * pad.half_extents)


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchInterval:
    """Frames between which the gripper can move the part.

    Attributes:
        first, last: Frame indices, both inside.
        gripped: The gripper closed on the part at `first` and opened after `last`; otherwise only the
            distance defines the interval, and neither end is sharp.
    """

    first: int
    last: int
    gripped: bool

    @property
    def frames(self) -> slice:
        """All frames of the interval."""
        return slice(self.first, self.last + 1)


def find_touch(signals: GripperSignals) -> TouchInterval:
    """Find the interval in which the gripper can move the part.

    If the gripper closes near the part, and not on itself, the interval lasts from there to where it
    opens again or the video ends. If it hardly moves or is closed (a hook, a push), only the distance
    counts: the interval begins at the first frame at which the fingers are about as near as they ever
    come, and lasts to the end.
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
    """Refine the touch of a gripper that grips nothing, by the distance of its whole surface.

    Knuckles and backs of fingers push as well as pads. The touch begins shortly before the surface is about
    as near as it ever comes, so that its first frames show the part at rest.

    Args:
        touch: Result of `find_touch`.
        times_s: Times of the frames (T,).
        gaps_m: Result of `measure_surface_gaps` (T,).
    """
    near = int(np.argmax(gaps_m <= float(gaps_m.min()) + _NEAR_TOUCH_M))
    return replace(touch, first=int(np.searchsorted(times_s, times_s[near] - REST_S)))


def measure_surface_gaps(demo: MotionInput, times_s: Array) -> Array:
    """Measure the smallest distance (T,) of the gripper's surface to the part, [m]; inf without meshes."""
    surface, tree = hand_surface(demo.robot), cKDTree(demo.points_moving)
    placed = (surface.pose(Ts)[0][::_EVERY] for Ts in demo.body_poses_at(times_s))
    return np.array([tree.query(points)[0].min(initial=np.inf) for points in placed])


def _plateau(run: NDArray[np.intp], grip: Array, tolerance: float) -> tuple[int, int]:
    """Find the frames of a run in which the grip stays at its usual value."""
    steady = run[np.abs(grip[run] - np.median(grip[run])) <= tolerance]
    return int(steady[0]), int(steady[-1])
