"""Carry the demonstrated motion of the end effector to an object at another pose.

The demonstration has four parts: the free motion of the arm, the approach near the handle, the contact, and the retreat.
During contact the end effector follows the new handle as a function of the joint value, at the demonstrated times. The
approach and the retreat move with the object. The free motion is planned in joint space (`planning`).
Source: AOMGen, sec. 4.3.3, "Pose Generalization". The paper rotates the contact segment rigidly; here
it is computed from the joint, so that the object may be another one.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator

from aomgen.core.demonstration import Demonstration, gripper_command, timing
from aomgen.core.episode import PHASES
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import (
    apply,
    invert,
    matrix_from_quat,
    matrix_from_rotvec,
    path_steps,
    quat_from_matrix,
    transform,
)
from aomgen.core.values import Array
from aomgen.episodes.grasps import Grasp

APPROACH, CONTACT, RETREAT = range(len(PHASES))
# Motion near the handle: as demonstrated, or straight along the approach direction of the end effector.
Style = Literal["demonstrated", "straight"]
# The last part of the approach, and the first of the retreat, moves with the object, [m].
NEAR_M = 0.10
# Least length of the free motion before it, [m]. A demonstration that starts nearer to the handle is extended
# by a rest at its start, as if the end effector came at this speed, [m/s].
FREE_M, REST_SPEED = 0.05, 0.1
# A rotation by one radian counts as this distance, [m].
TURN_WEIGHT_M = 0.15
# Before the contact the fingers are open by this much more than on the handle, as a share of their stroke:
# the handle is a few millimeters off the center.
ROOM = 0.09
# Number of poses per interval between two marks at which inverse kinematics
# is solved first: about 5 cm apart.
KNOTS = 16
# The intervals between the marks of a demonstration, and the phase of each.
FREE, NEAR, CLOSE, MOVE, OPEN, LEAVE = range(6)
INTERVAL_PHASES = (APPROACH, APPROACH, CONTACT, CONTACT, CONTACT, RETREAT)


class DemonstratedMotion:
    """The demonstration as a function of time, which all retargeted motions share; times are from its first sample, [s].

    Attributes:
        marks: Times (7,): start, `NEAR_M` before the grasp, fingers close, part moves, part
            rests, fingers are open, end.
        knots: Times (6, K) in each interval between two marks.
        lengths: Length of the end effector's path in each interval (6,), [m].
    """

    def __init__(self, demo: Demonstration) -> None:
        distances = np.linalg.norm(np.diff(demo.Ts_world_ee[:, :3, 3], axis=0), axis=1)
        before = demo.times_s[1:] - demo.times_s[0] <= timing(demo).close
        missing = NEAR_M + FREE_M - float(distances[before].sum())
        if missing > 0.0:
            demo, rows = _insert_rest(demo, missing / REST_SPEED)
            distances = np.concatenate([np.full(rows, missing / rows), distances])
        self.demo, self.moments = demo, timing(demo)
        self.times = demo.times_s - demo.times_s[0]
        positions, quats = demo.Ts_world_ee[:, :3, 3], quat_from_matrix(demo.Ts_world_ee[:, :3, :3])
        flips = np.cumprod(np.sign(np.sum(quats[1:] * quats[:-1], 1)) + 1e-12)
        quats[1:] *= np.sign(flips)[:, None]
        self._poses = Akima1DInterpolator(self.times, np.column_stack([positions, quats]))
        self._distances = np.concatenate([[0.0], np.cumsum(distances)])
        self._free_m = max(float(self.distance(self.moments.close)) - NEAR_M, FREE_M)
        near = min(float(np.interp(self._free_m, self._distances, self.times)), self.moments.close)
        self.marks: Array = np.insert(self.moments.marks, 1, near)
        self.knots: Array = np.linspace(self.marks[:-1], self.marks[1:], KNOTS, axis=1)
        poses = self.poses(self.knots.ravel()).reshape(*self.knots.shape, 4, 4)
        self.lengths = path_steps(poses, TURN_WEIGHT_M).sum(1)

    def gripper(self, times: Array, held_at: float) -> Array:
        """Return gripper commands (N,) for fingers that stall at `held_at`; they arrive wider open."""
        return np.interp(times, self.times, gripper_command(self.demo, max(held_at - ROOM, 0.0)))

    def poses(self, times: Array) -> Array:
        """Interpolate recorded end effector poses (N, 4, 4)."""
        poses = self._poses(np.clip(times, self.times[0], self.times[-1]))
        return transform(matrix_from_quat(poses[:, 3:]), poses[:, :3])

    def from_closed(self, fitted: FittedAsset) -> Array:
        """Return the knots (K,) of the contact, starting at the closed part.

        The demonstrated and the new end effector pose are most similar there: an object whose hinge is on the
        other side is held similarly only at the closed part.
        """
        return self.knots[MOVE][:: int(np.sign(fitted.travel))]

    def hand_at_closed(self, fitted: FittedAsset) -> Array:
        """Return the demonstrated end effector orientation (3, 3) at the closed part, asset frame."""
        return fitted.T_world_asset[:3, :3].T @ self.poses(self.from_closed(fitted)[:1])[0, :3, :3]

    def distance(self, times: Array | float) -> Array:
        """Compute the end effector's path length up to times (N,), [m]; an inserted rest counts."""
        return np.asarray(np.interp(times, self.times, self._distances))

    def joints(self, times: Array) -> Array:
        """Interpolate recorded arm joints (N, J)."""
        return np.stack([np.interp(times, self.times, column) for column in self.demo.joints.T], -1)

    def phases(self, times: Array) -> NDArray[np.int64]:
        """Return indices into `PHASES` (N,)."""
        close, free = self.moments.close, self.moments.free
        return np.where(times < close, APPROACH, np.where(times <= free, CONTACT, RETREAT))

    def bend(self, times: Array, start: Array, goal: Array) -> Array:
        """Shift demonstrated joints (N, J) of the free motion so that they go from `start` to `goal` (J,)."""
        shares = ease(self.distance(times) / self._free_m)[:, None]
        first, last = self.joints(self.marks[:2])
        return self.joints(times) + (1 - shares) * (start - first) + shares * (goal - last)

    def retime(self, stretches: Array, fps: float) -> Array:
        """Compute sample times of the demonstration (N,), each interval (6,) stretched by a factor."""
        new_marks = np.concatenate([[0.0], np.cumsum(np.diff(self.marks) * stretches)])
        samples = np.arange(int(new_marks[-1] * fps + 1e-6) + 1) / fps
        keep = np.concatenate([[True], np.diff(new_marks) > 1e-9])
        return np.interp(samples, new_marks[keep], self.marks[keep])


def _insert_rest(demo: Demonstration, seconds: float) -> tuple[Demonstration, int]:
    """Insert a rest at the start of a demonstration; returns also its number of samples."""
    step = float(demo.times_s[1] - demo.times_s[0])
    rows = int(np.ceil(seconds / step))
    extended = demo[np.maximum(np.arange(-rows, len(demo)), 0)]
    times = np.concatenate([demo.times_s[0] - step * np.arange(rows, 0, -1), demo.times_s])
    return replace(extended, times_s=times), rows


@dataclass(frozen=True, kw_only=True)
class RetargetedMotion:
    """End effector poses near a new object as a function of demonstration time.

    Attributes:
        shown: The demonstration.
        fitted, T_world_object: The object and its pose (4, 4).
        grasp: Grasp of the handle.
        style: Motion near the handle before and after the contact.
    """

    shown: DemonstratedMotion
    fitted: FittedAsset
    T_world_object: Array
    grasp: Grasp
    style: Style = "demonstrated"

    def thetas(self, times: Array) -> Array:
        """Compute the planned joint value (N,), [rad] or [m]."""
        moments = self.shown.moments
        return self.fitted.theta_at((times - moments.start) / max(moments.end - moments.start, 1e-9))

    def holding(self, times: Array) -> Array:
        """Compute end effector poses (N, 4, 4) that hold the handle at times (N,)."""
        asset, grasp, thetas = self.fitted.asset, self.grasp, self.thetas(times)
        held = apply(asset.joint.motion(thetas), self.fitted.contact_asset[None])
        R = np.broadcast_to(grasp.R_object_ee, (len(thetas), 3, 3))
        if asset.joint.type == "revolute":
            turns = grasp.turn_ratio * thetas
            R = matrix_from_rotvec(turns[:, None] * asset.joint.axis) @ R
        return self.T_world_object @ transform(R, held - np.einsum("nij,j->ni", R, grasp.held_ee))

    def at(self, times: Array) -> Array:
        """Compute end effector poses (N, 4, 4) at times from the second mark on."""
        shown, moments = self.shown, self.shown.moments
        ends = np.array([moments.close, moments.free])
        result = np.empty((len(times), 4, 4))
        before, after = times < moments.close, times > moments.free
        held = ~(before | after)
        result[held] = self.holding(times[held])
        (T_close, T_free), (T_demo_close, T_demo_free) = self.holding(ends), shown.poses(ends)
        left = shown.distance(moments.close) - shown.distance(times[before])
        gone = shown.distance(times[after]) - shown.distance(moments.free)
        if self.style == "demonstrated":
            result[before] = T_close @ invert(T_demo_close) @ shown.poses(times[before])
            result[after] = T_free @ invert(T_demo_free) @ shown.poses(times[after])
        else:
            result[before] = _back_off(T_close, left)
            result[after] = _back_off(T_free, np.minimum(gone, NEAR_M))
        return result

    @cached_property
    def knots(self) -> Array:
        """End effector poses (5, K, 4, 4) at the knots of all intervals but the free motion."""
        times = self.shown.knots[NEAR:]
        return self.at(times.ravel()).reshape(*times.shape, 4, 4)

    def stretches(self, free: Array) -> Array:
        """Compute by which factor (1 to 4) each of the six intervals must last longer, because its path is longer.

        The paths are compared with the demonstrated ones. The free motion and the approach near the handle share
        one factor. Poses `free` (N, 4, 4) are those of the free motion.
        """
        marks, demonstrated = self.shown.marks, self.shown.lengths
        new = np.append(path_steps(free, TURN_WEIGHT_M).sum(), path_steps(self.knots, TURN_WEIGHT_M).sum(1))
        whole = np.array([FREE, FREE, *range(CLOSE, LEAVE + 1)])
        new, demonstrated = (np.bincount(whole, lengths)[whole] for lengths in (new, demonstrated))
        moved = (demonstrated > 0.03) & (np.diff(marks) > 1e-6)
        return np.clip(np.where(moved, new / np.maximum(demonstrated, 1e-9), 1.0), 1.0, 4.0)


def _back_off(T_world_ee: Array, distances: Array) -> Array:
    """Compute poses (N, 4, 4) at distances (N,) behind a pose, along its approach direction, [m]."""
    return transform(T_world_ee[:3, :3], T_world_ee[:3, 3] - distances[:, None] * T_world_ee[:3, 2])


def ease(shares: Array) -> Array:
    """Ease shares, clipped to 0..1, so that their slope is zero at both ends."""
    shares = np.clip(shares, 0.0, 1.0)
    return shares * shares * (3 - 2 * shares)
