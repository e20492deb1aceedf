"""Carry the demonstrated hand motion to an object that stands elsewhere.

The demonstration falls into three segments. While the hand holds the handle, it follows the
new object as a function of its joint value, in the demonstrated time. Before, it leaves the
demonstrated start and bends towards the new grasp; after, it backs off from the new place.
Source: AOMGen, sec. 4.3.3, "Pose Generalization". The paper turns the contact segment rigidly; here
it is made anew from the joint, so that the object may be another one.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator

from aomgen.core.demonstration import Demonstration
from aomgen.core.episode import PHASES
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import (
    apply,
    invert,
    matrix_from_quat,
    matrix_from_rotvec,
    quat_from_matrix,
    rotvec_from_matrix,
    transform,
)
from aomgen.core.values import Array, freeze_arrays
from aomgen.episodes.grasps import Grasp

APPROACH, CONTACT, RETREAT = range(len(PHASES))
# How the hand moves beside the handle: as demonstrated, or straight along its approach direction.
Style = Literal["demonstrated", "straight"]
# The last stretch of the approach, and the first of the retreat, moves with the object, [m].
RIGID_STRETCH_M = 0.10
# A turn of one radian counts as this much way, [m].
TURN_WEIGHT_M = 0.15
# Smallest change of the gripper that is a grasp: fingers that reach under a lid are hardly open before.
MIN_GRASP = 0.05
# A gripper that measures less than this counts as open.
OPEN = 0.03


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


@dataclass(frozen=True, slots=True, kw_only=True)
class HandMotion:
    """A retargeted hand motion at a constant rate.

    Attributes:
        Ts_world_ee: Of the hand.
        gripper: Commanded, 0..1.
        thetas: Planned joint value, [rad] or [m].
        phases: Index into `PHASES`.
        demo_times_s: Moment of the demonstration that each sample answers to, [s].
        blend: Share of the new grasp in each approach pose: 0 at the start, 1 from where
            the hand moves with the object.
    """

    Ts_world_ee: Annotated[Array, "T 4 4"]
    gripper: Annotated[Array, "T"]
    thetas: Annotated[Array, "T"]
    phases: Annotated[NDArray[np.int64], "T"]
    demo_times_s: Annotated[Array, "T"]
    blend: Annotated[Array, "T"]

    __post_init__ = freeze_arrays


def gripper_command(demo: Demonstration) -> Array:
    """The command of the gripper (T,), 0..1, from what was measured.

    A gripper that holds a bar stalls before it is closed, so the level it stalls at counts as
    1; the level it comes with stays. A demonstration that closes nothing keeps what was measured.
    """
    opened, share = _closing(demo)
    return share if opened is None else opened + (1.0 - opened) * share


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


def retarget(
    demo: Demonstration,
    fitted: FittedAsset,
    T_world_object: Array,
    grasp: Grasp,
    fps: float,
    *,
    approach: Style = "demonstrated",
    retreat: Style = "demonstrated",
    slow_down: float = 1.0,
) -> HandMotion:
    """The hand's motion for an object at a new pose (4, 4), `fps` samples a second.

    Timing is the demonstration's; a longer approach or a longer opening takes proportionally longer, so that speeds
    stay as demonstrated. `slow_down`, at least 1, stretches both further; `approach` and `retreat` tell how the hand
    moves beside the handle.

    Not checked: reach, collisions.
    """
    moments = timing(demo)
    path = _HandPath(demo, fitted, T_world_object, grasp, moments, (approach, retreat))
    marks = moments.marks
    stretch = np.maximum(path.stretches(), 1.0)
    stretch[:3] *= slow_down
    new_marks = np.concatenate([[0.0], np.cumsum(np.diff(marks) * stretch)])
    samples = np.arange(int(new_marks[-1] * fps + 1e-6) + 1) / fps
    keep = np.concatenate([[True], np.diff(new_marks) > 1e-9])
    times = np.interp(samples, new_marks[keep], marks[keep])
    demo_times = demo.times_s - demo.times_s[0]
    phases = np.where(times < moments.close, APPROACH, np.where(times <= moments.free, CONTACT, RETREAT))
    return HandMotion(
        Ts_world_ee=path.at(times),
        gripper=np.interp(times, demo_times, gripper_command(demo)),
        thetas=path.thetas(times),
        phases=phases,
        demo_times_s=times,
        blend=path.blend(times),
    )


class _HandPath:
    """The new hand pose as a function of demonstration time; holds what all samples share."""

    def __init__(
        self,
        demo: Demonstration,
        fitted: FittedAsset,
        T_world_object: Array,
        grasp: Grasp,
        moments: Timing,
        styles: tuple[Style, Style],
    ) -> None:
        self.styles = styles
        self.demo, self.fitted, self.grasp, self.moments = demo, fitted, grasp, moments
        self.T_world_object = T_world_object
        self.times = demo.times_s - demo.times_s[0]
        positions, quats = demo.Ts_world_ee[:, :3, 3], quat_from_matrix(demo.Ts_world_ee[:, :3, :3])
        flips = np.cumprod(np.sign(np.sum(quats[1:] * quats[:-1], 1)) + 1e-12)
        quats[1:] *= np.sign(flips)[:, None]
        self._poses = Akima1DInterpolator(self.times, np.column_stack([positions, quats]))
        ways = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        self._ways = np.concatenate([[0.0], np.cumsum(ways)])

    def demonstrated(self, times: Array) -> Array:
        """Recorded hand poses (N, 4, 4)."""
        poses = self._poses(np.clip(times, self.times[0], self.times[-1]))
        return transform(matrix_from_quat(poses[:, 3:]), poses[:, :3])

    def thetas(self, times: Array) -> Array:
        """Planned joint value (N,)."""
        moments = self.moments
        return self.fitted.theta_at((times - moments.start) / max(moments.end - moments.start, 1e-9))

    def holding(self, thetas: Array) -> Array:
        """Hand poses (N, 4, 4) that hold the handle at joint values (N,)."""
        asset, grasp = self.fitted.asset, self.grasp
        held = apply(asset.joint.motion(thetas), self.fitted.contact_asset[None])
        R = np.broadcast_to(grasp.R_object_ee, (len(thetas), 3, 3))
        if asset.joint.type == "revolute":
            R = matrix_from_rotvec((grasp.turn_ratio * thetas)[:, None] * asset.joint.axis) @ R
        return self.T_world_object @ transform(R, held - np.einsum("nij,j->ni", R, grasp.held_ee))

    def at(self, times: Array) -> Array:
        """New hand poses (N, 4, 4)."""
        result = self.holding(self.thetas(times))
        before, after = times < self.moments.close, times > self.moments.free
        result[before] = self._approach(times[before])
        result[after] = self._retreat(times[after])
        return result

    def stretches(self) -> Array:
        """Length of the new way over the demonstrated one, between the marks (5,)."""
        marks = self.moments.marks
        ratios = []
        for first, last in pairwise(marks):
            times = np.linspace(first, last, 40)
            new, old = _length(self.at(times)), _length(self.demonstrated(times))
            ratios.append(new / old if old > 0.03 and last - first > 1e-6 else 1.0)
        return np.clip(ratios, 0.5, 4.0)

    def blend(self, times: Array) -> Array:
        """Share of the new grasp in the approach poses (N,), smooth in the way left to go."""
        close = self._way(np.array([self.moments.close]))
        left = close - self._way(times)
        total = max(float(close[0]) - RIGID_STRETCH_M, 1e-6)
        share = np.clip(1.0 - (left - RIGID_STRETCH_M) / total, 0.0, 1.0)
        return share * share * (3 - 2 * share)

    def _approach(self, times: Array) -> Array:
        close = np.array([self.moments.close])
        T_hold, T_demo_hold = self.holding(np.zeros(1))[0], self.demonstrated(close)[0]
        old = self.demonstrated(times)
        moved = self._beside(old, T_hold, T_demo_hold, self._way(close) - self._way(times), self.styles[0])
        return _blend(old, moved, self.blend(times))

    def _retreat(self, times: Array) -> Array:
        free = np.array([self.moments.free])
        T_hold = self.holding(self.thetas(free))[0]
        gone = self._way(times) - self._way(free)
        return self._beside(
            self.demonstrated(times), T_hold, self.demonstrated(free)[0], gone, self.styles[1]
        )

    def _beside(self, old: Array, T_hold: Array, T_demo_hold: Array, way: Array, style: Style) -> Array:
        """Poses near the handle: the demonstrated ones moved with it, or straight along the approach."""
        if style == "demonstrated":
            return T_hold @ invert(T_demo_hold) @ old
        return transform(T_hold[:3, :3], T_hold[:3, 3] - way[:, None] * T_hold[:3, 2])

    def _way(self, times: Array) -> Array:
        return np.interp(times, self.times, self._ways)


def _blend(Ts_a: Array, Ts_b: Array, shares: Array) -> Array:
    """Pairwise between two stacks (N, 4, 4): lerp of positions, slerp of rotations."""
    turns = rotvec_from_matrix(Ts_b[:, :3, :3] @ np.swapaxes(Ts_a[:, :3, :3], 1, 2))
    R = matrix_from_rotvec(shares[:, None] * turns) @ Ts_a[:, :3, :3]
    return transform(R, (1 - shares)[:, None] * Ts_a[:, :3, 3] + shares[:, None] * Ts_b[:, :3, 3])


def _length(Ts: Array) -> float:
    """Way and turn of a path (N, 4, 4), [m]."""
    ways = np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1)
    turns = np.linalg.norm(rotvec_from_matrix(Ts[1:, :3, :3] @ np.swapaxes(Ts[:-1, :3, :3], 1, 2)), axis=1)
    return float(ways.sum() + TURN_WEIGHT_M * turns.sum())
