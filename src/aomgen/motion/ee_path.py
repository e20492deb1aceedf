"""The hand's path while it holds the part, thinned to nodes at equal travel."""

from dataclasses import dataclass

import numpy as np

from aomgen.core.transforms import apply, rotvec_from_matrix
from aomgen.core.values import Array, freeze
from aomgen.motion import filters


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspGuess:
    """Where and how a hand holds a part, end-effector frame.

    Attributes:
        point_ee: First guess of the held point (3,), [m].
        closing_ee: Unit direction (3,) in which fingers press on the part from both sides, or None.
        sd_m: Standard deviation of the guess in each direction, [m].
    """

    point_ee: Array
    closing_ee: Array | None = None
    sd_m: float = 0.008

    def __post_init__(self) -> None:
        freeze(self, "point_ee", self.point_ee, (3,))
        if self.closing_ee is not None:
            freeze(self, "closing_ee", self.closing_ee, (3,))


@dataclass(frozen=True, slots=True, kw_only=True)
class EePath:
    """Averaged end-effector poses, equally spaced along the path, in the order of time.

    Attributes:
        Ts_world_ee: (K, 4, 4).
        hold: How it holds the part.
        length_m: Length of the grasped point's path, [m].
    """

    Ts_world_ee: Array
    hold: GraspGuess
    length_m: float

    def __post_init__(self) -> None:
        freeze(self, "Ts_world_ee", self.Ts_world_ee, (None, 4, 4))

    @property
    def points_world(self) -> Array:
        """The grasped point (K, 3), [m]."""
        return apply(self.Ts_world_ee, self.hold.point_ee)

    @property
    def closing_world(self) -> Array:
        """Direction (3,) in which the fingers press at the first node; zeros where they do not."""
        closing = self.hold.closing_ee
        return np.zeros(3) if closing is None else self.Ts_world_ee[0, :3, :3] @ closing

    @property
    def turns_world(self) -> Array:
        """Rotation vectors (K, 3) of the hand since the first node, world frame, [rad]."""
        rotations = self.Ts_world_ee[:, :3, :3]
        return unwrap_rotations(rotations @ rotations[0].T)


def unwrap_rotations(rotations: Array) -> Array:
    """Rotation vectors (K, 3) of rotations (K, 3, 3) that continue each other past half a turn."""
    turns = rotvec_from_matrix(rotations)
    for k in range(1, len(turns)):
        angle = float(np.linalg.norm(turns[k]))
        if angle > 1e-9:
            unit = turns[k] / angle
            turns[k] += unit * 2 * np.pi * np.round(((turns[k - 1] - turns[k]) @ unit) / (2 * np.pi))
    return turns


def thin_path(Ts_world_ee: Array, hold: GraspGuess, *, nodes: int, smooth: int) -> EePath:
    """Average a dense pose series (T, 4, 4) into `nodes` stretches of equal travel.

    Resting counts little this way, and noise of single samples averages out.

    Args:
        Ts_world_ee: (T, 4, 4) in the order of time.
        hold: Of the point whose travel is measured.
        nodes: Largest number of nodes; empty stretches are left out.
        smooth: Window of the smoother for measuring travel, in samples.
    """
    points = apply(Ts_world_ee, hold.point_ee)
    # A polynomial keeps the first and the last samples, in which a quick hand already goes far.
    smoothed = np.stack([filters.smooth(column, 1.0, smooth) for column in points.T], 1)
    steps = np.linalg.norm(np.diff(smoothed, axis=0), axis=1)
    travel = np.concatenate([[0.0], np.cumsum(steps)])
    bins = np.minimum((travel / max(travel[-1], 1e-12) * nodes).astype(int), nodes - 1)
    poses = [average_poses(Ts_world_ee[bins == k]) for k in np.unique(bins)]
    return EePath(Ts_world_ee=np.stack(poses), hold=hold, length_m=float(travel[-1]))


def average_poses(Ts: Array) -> Array:
    """The mean (4, 4) of poses (K, 4, 4) that are close to each other."""
    mean = Ts.mean(0)
    U, _, Vt = np.linalg.svd(mean[:3, :3])
    mean[:3, :3] = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return mean
