"""Path of the end effector: at dense times, averaged over equal travel, and relative to the part."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from aomgen.core.joint import Joint
from aomgen.core.transforms import apply, invert, rotvec_from_matrix, transform
from aomgen.core.values import Array, Vector3, freeze_arrays

# Joint logs of a resting robot drift by less than this after smoothing, [m].
_JITTER_M = 0.001
# Window of the smoother for measuring travel, in samples of 10 ms: short against any motion.
_TRAVEL_WINDOW = 11


def smooth(values: Array, step_s: float, window_s: float) -> Array:
    """Smooth a series (T,) by a Savitzky-Golay filter of second order, at least five samples wide."""
    window = max(5, 2 * round(window_s / step_s / 2) + 1)
    return np.asarray(savgol_filter(values, window, 2)) if len(values) > window else np.array(values)


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperPath:
    """Smooth positions of the gripper, world frame [m], at dense, increasing times [s]."""

    times_s: Annotated[Array, "D"]
    points: Annotated[Array, "D 3"]

    __post_init__ = freeze_arrays

    def between(self, first_s: float, last_s: float) -> "GripperPath":
        """Return the part of the path inside an interval."""
        inside = (self.times_s >= first_s - 1e-9) & (self.times_s <= last_s + 1e-9)
        return GripperPath(times_s=self.times_s[inside], points=self.points[inside])

    def reverse(self) -> "GripperPath":
        """Return the path in reverse, with negative times."""
        return GripperPath(times_s=-self.times_s[::-1], points=self.points[::-1])

    @property
    def travel(self) -> Array:
        """Largest distance (D,) from the first point up to each point, [m]; empty for a path without points."""
        return np.maximum.accumulate(np.linalg.norm(self.points - self.points[:1], axis=1))

    @property
    def length(self) -> Array:
        """Length (D,) of the path up to each point, [m]; motion back and forth within `_JITTER_M` is none."""
        gone, anchor = np.zeros(len(self.points)), 0
        for k in range(1, len(gone)):
            step = float(np.linalg.norm(self.points[k] - self.points[anchor]))
            gone[k] = max(gone[k - 1], gone[anchor] + step)
            anchor = k if step >= _JITTER_M else anchor
        return gone


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspGuess:
    """First estimate of the point at which a gripper holds a part, end-effector frame.

    Attributes:
        point_ee: First estimate of the held point, [m].
        closing_ee: Unit direction in which fingers press on the part from both sides, or None.
        sd_m: Standard deviation of the estimate in each direction, [m].
    """

    point_ee: Vector3
    closing_ee: Vector3 | None = None
    sd_m: float = 0.008

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class EePath:
    """Averaged end-effector poses, equally spaced along the path, in the order of time.

    Attributes:
        hold: Grasp of the part.
        points_world: The held point, [m].
        turns_world: Rotation vectors of the end effector since the first node, [rad].
    """

    Ts_world_ee: Annotated[Array, "K 4 4"]
    hold: GraspGuess
    points_world: Annotated[Array, "K 3"]
    turns_world: Annotated[Array, "K 3"]

    __post_init__ = freeze_arrays

    @property
    def closing_world(self) -> Array:
        """Direction (3,) in which the fingers press at the first node; zeros if they do not press."""
        closing = self.hold.closing_ee
        return np.zeros(3) if closing is None else self.Ts_world_ee[0, :3, :3] @ closing


def thin_path(Ts_world_ee: Array, hold: GraspGuess, *, nodes: int) -> EePath:
    """Average a dense pose series (T, 4, 4), in the order of time, into segments of equal travel.

    Rest periods count little this way, and noise of single samples averages out.

    Args:
        Ts_world_ee: Poses of the end effector.
        hold: Grasp, whose point defines the travel.
        nodes: Largest number of segments; empty ones are left out.
    """
    points = apply(Ts_world_ee, hold.point_ee)
    # A polynomial keeps the first and the last samples, in which a fast end effector already moves far.
    smoothed = np.stack([smooth(column, 1.0, _TRAVEL_WINDOW) for column in points.T], 1)
    travel = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(smoothed, axis=0), axis=1)))
    bins = np.minimum((travel / max(travel[-1], 1e-12) * nodes).astype(int), nodes - 1)
    Ts = np.stack([average_poses(Ts_world_ee[bins == k]) for k in np.unique(bins)])
    turns = unwrap_rotations(Ts[:, :3, :3] @ Ts[0, :3, :3].T)
    return EePath(Ts_world_ee=Ts, hold=hold, points_world=apply(Ts, hold.point_ee), turns_world=turns)


def average_poses(Ts: Array) -> Array:
    """Compute the mean (4, 4) of poses (K, 4, 4) that are close to each other."""
    return transform(Rotation.from_matrix(Ts[:, :3, :3]).mean().as_matrix(), Ts[:, :3, 3].mean(0))


def unwrap_rotations(rotations: Array) -> Array:
    """Convert rotations (K, 3, 3) to rotation vectors (K, 3) that stay continuous past half a turn."""
    turns = rotvec_from_matrix(rotations)
    for k in range(1, len(turns)):
        angle = float(np.linalg.norm(turns[k]))
        if angle > 1e-9:
            unit = turns[k] / angle
            turns[k] += unit * 2 * np.pi * np.round(((turns[k - 1] - turns[k]) @ unit) / (2 * np.pi))
    return turns


def measure_slip(
    joint: Joint, thetas: Array, Ts_world_ee: Array, grasp_ee: Array, reference: int
) -> tuple[Array, Array]:
    """Measure slip of the gripper along the part (T, 3), [m], and its rotation vectors against it (T, 3).

    Both are in world axes with the part at its scanned pose, and zero at the moment of index `reference`.

    Args:
        joint: Value 0 is the scanned state, world frame.
        thetas: Joint values (T,), [rad] or [m].
        Ts_world_ee: End-effector poses (T, 4, 4) at the same times, in the order of time.
        grasp_ee: Held point (3,), end-effector frame, [m].
        reference: Index of the moment at which slip and rotation are zero.

    Not checked: that the gripper touches the part. The result depends on the
    gripper's path as far as `thetas` do.
    """
    Ts_part_ee = invert(joint.motion(thetas)) @ Ts_world_ee
    points, rotations = apply(Ts_part_ee, grasp_ee), Ts_part_ee[:, :3, :3]
    turns = rotations @ rotations[reference].T
    forwards, backwards = unwrap_rotations(turns[reference:]), unwrap_rotations(turns[reference::-1])
    return points - points[reference], np.concatenate([backwards[:0:-1], forwards])
