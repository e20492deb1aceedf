"""Revolute and prismatic models of an end effector path, as residuals of their unknowns."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from aomgen.core.transforms import cross, make_tangent_basis
from aomgen.core.values import Array
from aomgen.motion.ee_path import EePath

# Median distance of handles from hinges, [m], and the standard deviation of its logarithm: 95 % of the distances are
# between 0.1 m (lids of boxes) and 1.2 m (doors at the end of an arm's reach).
RADIUS_M, RADIUS_SPREAD = 0.35, 0.6
# Initial radius of a nearly straight arc, [m].
_LARGE_RADIUS_M = 2.0
# A hinge is on the object, whose size has this uncertainty (standard deviation of the logarithm).
REACH_SPREAD = 0.1
# Rotation of the end effector divided by that of the part: most grippers follow, some handles rotate in them freely.
RATIO, RATIO_SD = 0.7, 0.4


@dataclass(frozen=True, kw_only=True)
class JointModel:
    """A joint that explains an end effector path.

    The first four unknowns describe the axis: its tilt relative to `start` (2), and its position across `start`,
    relative to the middle of the path (2). They have no prior.

    `start`: Initial direction of the axis (3,).
    """

    path: EePath
    start: Array

    # Step sizes of the unknowns (P,), and the kind of error in each row of `data`, see `NoisePrior`.
    steps: ClassVar[Array] = np.full(4, 1e-2)
    kinds: ClassVar[tuple[str, ...]] = ()

    @cached_property
    def middle(self) -> Array:
        """Reference point (3,), [m]."""
        return self.path.points_world.mean(0)

    @cached_property
    def tangents(self) -> Array:
        """Unit vectors (2, 3) across `start`."""
        return make_tangent_basis(self.start)

    def lines(self, x: Array) -> tuple[Array, Array]:
        """Compute directions and points (..., 3) of the axes for unknowns (..., P)."""
        point, axis, *_ = self._frame(x)
        return axis, point

    def about(self, x: Array) -> tuple[Self, Array]:
        """Return an equal model whose `start` is the axis of the unknowns, and the unknowns relative to it."""
        axis, point = self.lines(x)
        place = make_tangent_basis(axis) @ (point - self.middle)
        return replace(self, start=axis), np.concatenate([np.zeros(2), place, x[4:]])

    def grasp(self, x: Array) -> Array:
        """Compute the held point (..., 3), end-effector frame, [m]."""
        return np.broadcast_to(self.path.hold.point_ee, (*x.shape[:-1], 3))

    def prior_residuals(self, x: Array) -> Array:
        """Compute residuals (..., Q) of the prior, in standard deviations."""
        return np.zeros((*x.shape[:-1], 0))

    @property
    def log_prior_norm(self) -> float:
        """Normalization of `prior_residuals`."""
        return 0.0

    def log_diffuse_position_prior(self, x: Array) -> float:
        """Compute the log density of the axis position if only the usual size is known."""
        return 0.0

    def _frame(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """Compute position and direction of the axis, and two unit vectors across it, (..., 3) each."""
        tangents = self.tangents
        axis = self.start + x[..., :2] @ tangents
        axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
        first = tangents[0] - (axis @ tangents[0])[..., None] * axis
        first = first / np.linalg.norm(first, axis=-1, keepdims=True)
        return self.middle + x[..., 2:4] @ tangents, axis, first, cross(axis, first)

    def _coordinates(
        self, points: Array, frame: tuple[Array, Array, Array, Array]
    ) -> tuple[Array, Array, Array]:
        """Compute coordinates (..., K) of points (..., K, 3) along the axis and the two unit vectors across it.

        The coordinate along the axis is relative to the middle of the path.
        """
        place, axis, first, second = frame
        offsets = points - place[..., None, :]
        first, second = ((offsets @ unit[..., None])[..., 0] for unit in (first, second))
        return ((points - self.middle) @ axis[..., None])[..., 0], first, second


@dataclass(frozen=True, kw_only=True)
class Revolute(JointModel):
    """The held point rotates about an axis, and the end effector rotates by a constant share of its angle.

    There are six further unknowns: radius and height of the held point (2), the held point relative to its initial
    value (3), and the share of the rotation.

    `reach_m`: Distance of the object's farthest point from the middle of the path; no hinge is farther away.
    """

    reach_m: float = np.inf

    kinds = ("face", "bar", "tilt", "tilt", "pivot")
    steps = np.array([*[1e-2] * 6, *[3e-3] * 3, 0.1])
    closing_alignment = 1.0

    def grasp(self, x: Array) -> Array:
        """Compute the held point (..., 3), end-effector frame, [m]."""
        return self.path.hold.point_ee + x[..., 6:9]

    def values(self, x: Array) -> Array:
        """Compute the rotation of the part (K,) since the first node, [rad]."""
        return self._roll(x, self._frame(x))[2]

    def data(self, x: Array) -> Array:
        """Compute the residuals (..., 5, K) in the order of `kinds`, [m] or [rad], of unknowns (..., 10)."""
        frame = self._frame(x)
        radii, heights, angles = self._roll(x, frame)
        axis, first, second = ((self.path.turns_world @ unit[..., None])[..., 0] for unit in frame[1:])
        rows = [radii - x[..., 4:5], heights - x[..., 5:6], first, second, axis - x[..., 9:] * angles]
        return np.stack(rows, axis=-2)

    def _roll(self, x: Array, frame: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Compute distance from the axis, height along it and angle about it (..., K) of the held point."""
        Ts = self.path.Ts_world_ee
        points = (Ts[:, :3, :3] @ self.grasp(x)[..., None, :, None])[..., 0] + Ts[:, :3, 3]
        heights, first, second = self._coordinates(points, frame)
        angles = np.unwrap(np.arctan2(second, first))
        return np.hypot(first, second), heights, angles - angles[..., :1]

    def first(self) -> Array:
        """Compute initial unknowns (10,) from an algebraic circle."""
        turns = self.path.turns_world @ self.start
        offsets = (self.path.points_world - self.middle) @ self.tangents.T
        center, radius = fit_circle(offsets, float(turns[-1] - turns[0]))
        return np.array([0, 0, *center, radius, 0, 0, 0, 0, RATIO], np.float64)

    def prior_residuals(self, x: Array) -> Array:
        """Compute residuals (..., 6) of held point, share of the rotation, usual size and the object's size."""
        radius = np.maximum(np.abs(x[..., 4:5]), 1e-3)
        size = np.log(radius / RADIUS_M) / RADIUS_SPREAD
        beyond = np.log(np.maximum(radius / self.reach_m, 1.0)) / REACH_SPREAD
        ratio = (x[..., 9:] - RATIO) / RATIO_SD
        return np.concatenate([x[..., 6:9] / self.path.hold.sd_m, ratio, size, beyond], axis=-1)

    @property
    def log_prior_norm(self) -> float:
        """Normalization of `prior_residuals`."""
        return -float(np.log(self.path.hold.sd_m) * 3 + np.log(RATIO_SD) + 2 * np.log(2 * np.pi))

    def log_diffuse_position_prior(self, x: Array) -> float:
        """Compute the log density of the axis position if only the usual size is known, see `prior_residuals`."""
        return -float(np.log(2 * np.pi * x[4] ** 2) + np.log(RADIUS_SPREAD * np.sqrt(2 * np.pi)))


class Prismatic(JointModel):
    """The held point moves on a line, and the end effector does not rotate; there are no further unknowns.

    Fingers constrain the part in their closing direction, and it slips along their pads. Therefore a path deviates less
    in the closing direction (more precisely, in its component across the motion) than across it.
    """

    kinds = ("straight", "bar", "tilt", "tilt", "tilt")

    @property
    def closing_alignment(self) -> float:
        """Squared cosine between the closing direction and the direction of the first row of `data`."""
        across = self.tangents @ self.path.closing_world
        return float(across @ across)

    def values(self, x: Array) -> Array:
        """Compute the travel of the part (K,) since the first node, [m]."""
        along = self._coordinates(self.path.points_world, self._frame(x))[0]
        return along - along[0]

    def data(self, x: Array) -> Array:
        """Compute the residuals (..., 5, K) in the order of `kinds`, [m] or [rad], of unknowns (..., 4)."""
        _, first, second = self._coordinates(self.path.points_world, self._frame(x))
        across = self.tangents @ self.path.closing_world
        c, s = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-9 else (1.0, 0.0)
        rows = np.stack([c * first + s * second, c * second - s * first], axis=-2)
        turns = self.path.turns_world.T
        return np.concatenate([rows, np.broadcast_to(turns, (*x.shape[:-1], *turns.shape))], axis=-2)

    def first(self) -> Array:
        """Compute initial unknowns (4,)."""
        return np.zeros(4)


def make_models(path: EePath, reach_m: float) -> tuple[list[Revolute], Prismatic]:
    """Make a revolute model for each plausible axis direction, and a prismatic model along the chord of the path.

    The axis directions are the rotation axis of the end effector and four directions across the chord, because a
    short or noisy arc hardly determines its plane. No hinge is farther than `reach_m` from the middle of the path.
    """
    turning = np.linalg.svd(path.turns_world)[2][0]
    along, second, third = np.linalg.svd(path.points_world - path.points_world.mean(0))[2]
    axes = [turning, third, second, (third + second) / np.sqrt(2), (third - second) / np.sqrt(2)]
    doors = [Revolute(path=path, start=axis, reach_m=reach_m) for axis in axes]
    return doors, Prismatic(path=path, start=along)


def fit_circle(flat: Array, turn: float) -> tuple[Array, float]:
    """Fit an algebraic circle to points (K, 2); return center (2,) and radius, [m].

    For a nearly straight path the arc of the circle is set to the rotation `turn` of the end effector, [rad].
    Source: Kasa, 1976.
    """
    A = np.column_stack([2 * flat, np.ones(len(flat))])
    (x, y, c), *_ = np.linalg.lstsq(A, (flat**2).sum(1), rcond=None)
    radius = float(np.sqrt(max(c + x * x + y * y, 1e-12)))
    if radius < _LARGE_RADIUS_M:
        return np.array([x, y]), radius
    chord = flat[-1] - flat[0]
    length = float(np.linalg.norm(chord))
    radius = length / max(abs(turn), length / _LARGE_RADIUS_M)
    side = np.array([-chord[1], chord[0]]) / max(length, 1e-9) * (1.0 if turn >= 0 else -1.0)
    return radius * side, radius
