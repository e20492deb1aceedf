"""What the robot's own log says at given moments: hand pose, speed, grip and distance to the part."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.core.joint_log import JointLog
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.robots.gripper_surface import hand_surface
from aomgen.robots.robot import FingerPad, RobotModel

# Points along either side of a pad's face: pads are some 2 cm long, so 2 to 3 mm apart, as points of the
# part.
_PAD_GRID = 9
# Speeds are differences over this time, [s]: ten rows of a 100 Hz log, so that its noise averages out.
_SPEED_WINDOW_S = 0.1
# A gripper that moves less than this share of its stroke tells nothing about grasp and release.
_MIN_STROKE = 0.15
# A gripper that closes farther away than this from the part grasps something else, [m].
_NEAR_GRASP_M = 0.10
# A gripper that closes beyond this holds nothing: its pads meet at about 0.97, and 3 mm keep them from it.
EMPTY_GRIP = 0.96
# Fingers this much farther away than at their nearest count as touching, [m].
_NEAR_TOUCH_M = 0.01
# A video of the part at rest that ends when the hand is near, [s].
_REST_S = 0.25
# Every so many points of the hand's surface tell its distance, 1 cm apart.
_EVERY = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperSignals:
    """The hand over video times (T,).

    Attributes:
        times_s: Video clock, (T,).
        Ts_world_ee: (T, 4, 4).
        speeds_m_s: (T,).
        gripper: (T,), 0 open .. 1 closed.
        distances_m: Smallest distance of a finger pad to the part at its scanned place (T,), [m].
    """

    times_s: Annotated[Array, "T"]
    Ts_world_ee: Annotated[Array, "T 4 4"]
    speeds_m_s: Annotated[Array, "T"]
    gripper: Annotated[Array, "T"]
    distances_m: Annotated[Array, "T"]

    __post_init__ = freeze_arrays


def read_gripper_signals(
    robot: RobotModel, log: JointLog, points_moving: Array, times_s: Array
) -> GripperSignals:
    """Evaluate the log at video times (T,).

    Args:
        robot: Kinematics and finger pads; without pads the end effector's distance counts.
        log: The joint log, on the video's clock.
        points_moving: Points of the moving part at its scanned place (N, 3), world frame, [m].
        times_s: Video times (T,).
    """
    joints, gripper = log.at(times_s)
    half = _SPEED_WINDOW_S / 2
    before = robot.ee_poses(log.at(times_s - half)[0])
    after = robot.ee_poses(log.at(times_s + half)[0])
    Ts_world_ee = robot.ee_poses(joints)
    if robot.pads:
        bodies = robot.link_poses(joints, gripper)
        posed = np.stack([apply(bodies[:, None, pad.body], _sample_face(pad)) for pad in robot.pads], 1)
    else:
        posed = Ts_world_ee[:, None, None, :3, 3]
    distances = cKDTree(points_moving).query(posed.reshape(-1, 3))[0].reshape(len(times_s), -1).min(1)
    return GripperSignals(
        times_s=times_s,
        Ts_world_ee=Ts_world_ee,
        speeds_m_s=np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1) / _SPEED_WINDOW_S,
        gripper=gripper,
        distances_m=distances,
    )


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


def find_touch(signals: GripperSignals) -> TouchInterval:
    """When the hand can move the part.

    A gripper that closes near the part, and not upon itself, says it best; to where it opens again or
    the video ends. One that hardly moves or is closed (a hook, a push) leaves the distance: from the first
    frame at which the fingers are about as near as they ever come, to the end.
    """
    count = len(signals.times_s)
    grip = signals.gripper
    stroke = float(grip.max() - grip.min())
    if stroke >= _MIN_STROKE:
        closed = np.flatnonzero(grip > (grip.max() + grip.min()) / 2)
        closed = np.split(closed, np.flatnonzero(np.diff(closed) > 1) + 1)
        holding = [run for run in closed if np.median(grip[run]) < EMPTY_GRIP]
        grasps = [_plateau(run, grip, 0.1 * stroke) for run in holding]
        near_ones = [
            (first, last)
            for first, last in grasps
            if signals.distances_m[first] <= _NEAR_GRASP_M and last > first
        ]
        if near_ones:
            first, last = min(near_ones, key=lambda grasp: signals.distances_m[grasp[0]])
            return TouchInterval(first=first, last=last, gripped=True)
    near = signals.distances_m <= float(signals.distances_m.min()) + _NEAR_TOUCH_M
    return TouchInterval(first=int(np.argmax(near)), last=count - 1, gripped=False)


def refine_touch(touch: TouchInterval, signals: GripperSignals, gaps_m: Array) -> TouchInterval:
    """The touch of a hand that grips nothing, by the distance of its whole surface.

    Knuckles and backs of fingers push as well as pads. It begins a moment before the surface is about as
    near as it ever comes, so that its first frames show the part at rest.

    Args:
        touch: From `find_touch`.
        signals: Of the same frames.
        gaps_m: Smallest distance of the hand's surface to the part at its scanned place (T,), [m].
    """
    near = int(np.argmax(gaps_m <= float(gaps_m.min()) + _NEAR_TOUCH_M))
    first = int(np.searchsorted(signals.times_s, signals.times_s[near] - _REST_S))
    return replace(touch, first=first)


def measure_surface_gaps(robot: RobotModel, log: JointLog, points_moving: Array, times_s: Array) -> Array:
    """Smallest distance (T,) of the hand's surface to the part at its scanned place, [m].

    Args: as in `read_gripper_signals`; infinite for an arm without a hand.
    """
    surface = hand_surface(robot)
    bodies = robot.link_poses(*log.at(times_s))
    tree = cKDTree(points_moving)
    if not len(surface.points_body):
        return np.full(len(times_s), np.inf)
    return np.array([tree.query(surface.posed(Ts)[0][::_EVERY])[0].min() for Ts in bodies])


def _plateau(run: NDArray[np.intp], grip: Array, tolerance: float) -> tuple[int, int]:
    """Frames of a run in which the grip stays at its usual value."""
    steady = run[np.abs(grip[run] - np.median(grip[run])) <= tolerance]
    return int(steady[0]), int(steady[-1])
