"""Carry the demonstrated hand motion to an object that stands elsewhere.

The demonstration falls into three segments. While the hand holds the handle, it follows the
new object as a function of its joint value, in the demonstrated time. Before, it leaves the
demonstrated start and bends towards the new grasp; after, it backs off from the new place.
Source: AOMGen, sec. 4.3.3, "Pose Generalization". The paper turns the contact segment rigidly; here
it is made anew from the joint, so that the object may be another one.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import Akima1DInterpolator

from aomgen.core.demonstration import Demonstration, gripper_command, timing
from aomgen.core.episode import PHASES
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import (
    apply,
    interpolate,
    invert,
    matrix_from_quat,
    matrix_from_rotvec,
    path_steps,
    quat_from_matrix,
    rotvec_from_matrix,
    transform,
)
from aomgen.core.values import Array, freeze_arrays
from aomgen.episodes.grasps import Grasp

APPROACH, CONTACT, RETREAT = range(len(PHASES))
# How the hand moves beside the handle: as demonstrated, or straight along its approach direction.
Style = Literal["demonstrated", "straight"]
# The free way to the object: demonstrated poses that bend towards it, as the paper has it; demonstrated joints that
# do so, which no singular pose can spoil; or straight in the joints.
FreeWay = Literal["cartesian", "joints", "direct"]
# The last stretch of the approach, and the first of the retreat, moves with the object, [m].
RIGID_STRETCH_M = 0.10
# On at least so much way before that stretch the hand goes to the new place, [m]. A film that begins nearer to the
# handle is given a rest at its start, as if the hand came at this speed, [m/s].
FREE_WAY_M, REST_SPEED = 0.05, 0.1
# A turn of one radian counts as this much way, [m].
TURN_WEIGHT_M = 0.15
# Fingers come this much wider than they will hold, as a share of their stroke: what is held lies some millimetres off
# the middle.
ROOM = 0.09
# Poses of each interval between two marks from which the others are solved: some 5 cm apart.
KNOTS = 16


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


class Ways(NamedTuple):
    """How the hand comes and goes beside the handle; see `RetargetedMotion`."""

    approach: Style = "demonstrated"
    retreat: Style = "demonstrated"
    stretch: float = RIGID_STRETCH_M
    lift: float = 0.0


# And how the free way is made.
TriedWays = tuple[Ways, tuple[FreeWay, ...]]
# In the order in which they are tried: the demonstrated ones first.
WAYS: tuple[TriedWays, ...] = (
    (Ways(), ("cartesian", "joints")),
    (Ways("straight", "straight"), ("joints",)),
)
# Then, where only a collision beside the handle is in the way: from farther in front, or over what blocks.
DETOURS: tuple[TriedWays, ...] = (
    (Ways("straight", "straight", stretch=0.25), ("direct",)),
    (Ways(lift=0.25), ("cartesian",)),
)


class DemonstratedMotion:
    """What a demonstration gives to all its retargeted motions; times are from its first sample, [s]."""

    def __init__(self, demo: Demonstration) -> None:
        ways = np.linalg.norm(np.diff(demo.Ts_world_ee[:, :3, 3], axis=0), axis=1)
        before = demo.times_s[1:] - demo.times_s[0] <= timing(demo).close
        missing = RIGID_STRETCH_M + FREE_WAY_M - float(ways[before].sum())
        if missing > 0.0:
            demo, rows = _rested(demo, missing / REST_SPEED)
            ways = np.concatenate([np.full(rows, missing / rows), ways])
        self.demo, self.moments = demo, timing(demo)
        self.times = demo.times_s - demo.times_s[0]
        positions, quats = demo.Ts_world_ee[:, :3, 3], quat_from_matrix(demo.Ts_world_ee[:, :3, :3])
        flips = np.cumprod(np.sign(np.sum(quats[1:] * quats[:-1], 1)) + 1e-12)
        quats[1:] *= np.sign(flips)[:, None]
        self._poses = Akima1DInterpolator(self.times, np.column_stack([positions, quats]))
        self._ways = np.concatenate([[0.0], np.cumsum(ways)])
        # Knots between the marks (5, K).
        self.knots: Array = np.linspace(self.moments.marks[:-1], self.moments.marks[1:], KNOTS, axis=1)
        poses = self.poses(self.knots.ravel()).reshape(*self.knots.shape, 4, 4)
        self.lengths = path_steps(poses, TURN_WEIGHT_M).sum(1)

    def gripper(self, times: Array, held_at: float) -> Array:
        """Command of the gripper (N,) for a handle on which the fingers stall at `held_at`; they come wider than that."""
        return np.interp(times, self.times, gripper_command(self.demo, max(held_at - ROOM, 0.0)))

    def poses(self, times: Array) -> Array:
        """Recorded hand poses (N, 4, 4)."""
        poses = self._poses(np.clip(times, self.times[0], self.times[-1]))
        return transform(matrix_from_quat(poses[:, 3:]), poses[:, :3])

    def from_closed(self, fitted: FittedAsset) -> Array:
        """Knots (K,) of the contact from the closed part on.

        There demonstrated and new hand are most alike: an object whose hinge is on the other side is held alike only there.
        """
        return self.knots[2][:: int(np.sign(fitted.travel))]

    def hand_at_closed(self, fitted: FittedAsset) -> Array:
        """Demonstrated hand (3, 3) at the closed part, in the frame of the fitted asset."""
        return fitted.T_world_asset[:3, :3].T @ self.poses(self.from_closed(fitted)[:1])[0, :3, :3]

    def way(self, times: Array | float) -> Array:
        """Way of the hand up to times (N,), [m]; a rest before the film counts as one."""
        return np.asarray(np.interp(times, self.times, self._ways))

    def joints(self, times: Array) -> Array:
        """Recorded arm joints (N, J)."""
        return np.stack([np.interp(times, self.times, column) for column in self.demo.joints.T], -1)


def _rested(demo: Demonstration, seconds: float) -> tuple[Demonstration, int]:
    """A demonstration with a rest at its start before it, and how many samples that takes."""
    step = float(demo.times_s[1] - demo.times_s[0])
    rows = int(np.ceil(seconds / step))
    first = {
        name: np.concatenate([np.repeat(values[:1], rows, axis=0), values])
        for name in ("joints", "gripper", "Ts_world_ee", "thetas")
        for values in [getattr(demo, name)]
    }
    times = np.concatenate([demo.times_s[0] - step * np.arange(rows, 0, -1), demo.times_s])
    return replace(demo, times_s=times, **first), rows


@dataclass(frozen=True, kw_only=True)
class RetargetedMotion:
    """The new hand pose as a function of demonstration time, for one object, grasp and way of coming and going.

    Attributes:
        shown: The demonstration.
        fitted, T_world_object: The object and where it stands (4, 4).
        grasp: How the hand holds.
        held_at: Gripper value 0..1 at which the fingers stall on the handle.
        approach, retreat: How the hand moves beside the handle.
        T_world_start: Where the hand begins (4, 4); where it was demonstrated if None.
        stretch: How far from the handle the hand moves with the object, [m].
        lift: By how much the way there and back is raised between its ends, [m].
        rigid: The paper's method: the contact segment turned with the object, straight ways there and back.
    """

    shown: DemonstratedMotion
    fitted: FittedAsset
    T_world_object: Array
    grasp: Grasp
    held_at: float = 1.0
    approach: Style = "demonstrated"
    retreat: Style = "demonstrated"
    T_world_start: Array | None = None
    stretch: float = RIGID_STRETCH_M
    lift: float = 0.0
    rigid: bool = False

    def sample(self, fps: float, *, speed: float = 1.0, slow_down: ArrayLike = (1.0, 1.0, 1.0)) -> HandMotion:
        """The motion, `fps` samples a second.

        Timing is the demonstration's times `speed`; a longer approach or a longer opening takes proportionally longer,
        so that speeds stay as asked. `slow_down`, at least 1, stretches each phase (3,) further.
        """
        moments, marks = self.shown.moments, self.shown.moments.marks
        # Approach, three intervals of contact, retreat.
        stretch = (
            self.stretches * np.asarray(slow_down)[[APPROACH, CONTACT, CONTACT, CONTACT, RETREAT]] / speed
        )
        new_marks = np.concatenate([[0.0], np.cumsum(np.diff(marks) * stretch)])
        samples = np.arange(int(new_marks[-1] * fps + 1e-6) + 1) / fps
        keep = np.concatenate([[True], np.diff(new_marks) > 1e-9])
        times: Array = np.interp(samples, new_marks[keep], marks[keep])
        phases = np.where(times < moments.close, APPROACH, np.where(times <= moments.free, CONTACT, RETREAT))
        return HandMotion(
            Ts_world_ee=self.at(times),
            gripper=self.shown.gripper(times, self.held_at),
            thetas=self.thetas(times),
            phases=phases,
            demo_times_s=times,
            blend=self.blend(times),
        )

    def thetas(self, times: Array) -> Array:
        """Planned joint value (N,)."""
        moments = self.shown.moments
        return self.fitted.theta_at((times - moments.start) / max(moments.end - moments.start, 1e-9))

    def holding(self, times: Array) -> Array:
        """Hand poses (N, 4, 4) that hold the handle at times (N,)."""
        if self.rigid:
            return self.T_world_object @ invert(self.fitted.T_world_asset) @ self.shown.poses(times)
        asset, grasp, thetas = self.fitted.asset, self.grasp, self.thetas(times)
        held = apply(asset.joint.motion(thetas), self.fitted.contact_asset[None])
        R = np.broadcast_to(grasp.R_object_ee, (len(thetas), 3, 3))
        if asset.joint.type == "revolute":
            turns = grasp.turn_ratio * thetas
            R = matrix_from_rotvec(turns[:, None] * asset.joint.axis) @ R
        return self.T_world_object @ transform(R, held - np.einsum("nij,j->ni", R, grasp.held_ee))

    def at(self, times: Array) -> Array:
        """New hand poses (N, 4, 4)."""
        moments, (T_close, T_free) = self.shown.moments, self._ends
        result = np.empty((len(times), 4, 4))
        before, after = times < moments.close, times > moments.free
        held = ~(before | after)
        result[held] = self.holding(times[held])
        result[before] = self._coming(times[before], T_close)
        result[after] = self._going(times[after], T_free)
        return result

    @cached_property
    def knots(self) -> Array:
        """New hand poses at the demonstration's knots (5, K, 4, 4)."""
        times = self.shown.knots
        return self.at(times.ravel()).reshape(*times.shape, 4, 4)

    @cached_property
    def stretches(self) -> Array:
        """Length of the new way over the demonstrated one, at least 1, between the marks (5,)."""
        shown = self.shown
        new = path_steps(self.knots, TURN_WEIGHT_M).sum(1)
        moved = (shown.lengths > 0.03) & (np.diff(shown.moments.marks) > 1e-6)
        return np.clip(np.where(moved, new / np.maximum(shown.lengths, 1e-9), 1.0), 1.0, 4.0)

    def blend(self, times: Array) -> Array:
        """Share of the new grasp in the approach poses (N,), smooth in the way left to go."""
        shown, close = self.shown, self.shown.moments.close
        if self.rigid:
            return np.clip(times / max(close, 1e-9), 0.0, 1.0)
        free = max(float(shown.way(close)) - self.stretch, FREE_WAY_M)
        return _smoothstep(shown.way(times) / free)

    @cached_property
    def _ends(self) -> Array:
        """Hand poses when it closes and when it is free again (2, 4, 4)."""
        moments = self.shown.moments
        return self.holding(np.array([moments.close, moments.free]))

    def _coming(self, times: Array, T_close: Array) -> Array:
        shown, close = self.shown, self.shown.moments.close
        old, blend = shown.poses(times), self.blend(times)
        T_start = shown.demo.Ts_world_ee[0] if self.T_world_start is None else self.T_world_start
        if self.rigid:
            return interpolate(T_start, T_close, blend)
        if self.T_world_start is not None:
            # The start's change of place and of orientation fades.
            turn = rotvec_from_matrix(T_start[:3, :3] @ shown.demo.Ts_world_ee[0, :3, :3].T)
            old[:, :3, :3] = matrix_from_rotvec((1 - blend)[:, None] * turn) @ old[:, :3, :3]
            old[:, :3, 3] += (1 - blend)[:, None] * (T_start - shown.demo.Ts_world_ee[0])[:3, 3]
        left = shown.way(close) - shown.way(times)
        moved = self._beside(old, T_close, shown.poses(np.array([close]))[0], left, self.approach)
        Ts = interpolate(old, moved, blend)
        # Up in the first quarter, down in the last.
        Ts[:, 2, 3] += self.lift * _smoothstep(4 * np.minimum(blend, 1 - blend))
        return Ts

    def _going(self, times: Array, T_free: Array) -> Array:
        shown, free = self.shown, self.shown.moments.free
        if self.rigid:
            shares = (times - free) / max(shown.moments.last - free, 1e-9)
            return interpolate(T_free, shown.demo.Ts_world_ee[-1], shares)
        gone = shown.way(times) - shown.way(free)
        Ts = self._beside(shown.poses(times), T_free, shown.poses(np.array([free]))[0], gone, self.retreat)
        Ts[:, 2, 3] += self.lift * _smoothstep((gone - self.stretch) / max(self.lift, 1e-6))
        return Ts

    def _beside(self, old: Array, T_hold: Array, T_demo_hold: Array, way: Array, style: Style) -> Array:
        """Poses near the handle: the demonstrated ones moved with it, or straight along the approach."""
        if style == "demonstrated":
            return T_hold @ invert(T_demo_hold) @ old
        return transform(T_hold[:3, :3], T_hold[:3, 3] - way[:, None] * T_hold[:3, 2])


def free_joints(
    shown: DemonstratedMotion, motion: HandMotion, start: Array, goal: Array, free: int, free_way: FreeWay
) -> Array:
    """Joints (free, J) from the start to `goal`: the demonstrated ones, bent at both ends, or straight."""
    if free_way == "direct":
        shares = _smoothstep(np.arange(free) / max(free, 1))[:, None]
        return start + shares * (goal - start)
    joints = shown.joints(motion.demo_times_s[: free + 1])
    blend = motion.blend[:free, None]
    return joints[:free] + (1 - blend) * (start - joints[0]) + blend * (goal - joints[free])


def _smoothstep(shares: Array) -> Array:
    """Shares, cut to 0..1, that begin and end level."""
    shares = np.clip(shares, 0.0, 1.0)
    return shares * shares * (3 - 2 * shares)
