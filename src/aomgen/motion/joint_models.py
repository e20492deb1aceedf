"""What a revolute and a prismatic joint predict of the hand's path, as residuals of their unknowns."""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.core.values import Array, freeze
from aomgen.motion.ee_path import EePath

# Distance of handles from hinges, [m]: from lids of boxes to doors at the end of an arm's reach, 0.1 to
# 1.2 m with 95 %; and the spread of its logarithm.
RADIUS_M, RADIUS_SPREAD = 0.35, 0.6
MIN_RADIUS_M, MAX_RADIUS_M = 0.05, 2.0
# A hinge is on the object; its size is known to this share, as spread of the logarithm.
REACH_SPREAD = 0.1
# Turn of the hand over turn of the part: most hands follow, some handles turn in them freely.
RATIO, RATIO_SD = 0.7, 0.4
# A direction is known to nothing: density over the sphere, [1/sr].
LOG_ANY_DIRECTION = -float(np.log(4 * np.pi))


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A joint's axis: unit direction (3,), and the point of it nearest the path's middle (3,), [m]."""

    axis: Array
    point: Array

    def __post_init__(self) -> None:
        freeze(self, "axis", self.axis, (3,))
        freeze(self, "point", self.point, (3,))


@dataclass(frozen=True, slots=True, kw_only=True)
class Revolute:
    """The held point goes round an axis and the hand turns with it by a steady share.

    Unknowns (10,): tilt of the axis against `start` (2), its place across `start` from `middle` (2),
    radius and height of the held point (2), held point against its first guess (3), share of the turn.

    Attributes:
        path: The hand's path.
        turns_world: Its `turns_world` (K, 3).
        start: First guess of the axis (3,).
        middle: Reference point (3,), [m].
        reach_m: The object's farthest point from the path's middle; no hinge is farther away, [m].
    """

    path: EePath
    turns_world: Array
    start: Array
    middle: Array
    reach_m: float

    kinds = ("face", "bar", "tilt", "tilt", "pivot")
    firmness = 1.0
    steps = np.array([1e-2, 1e-2, *[1e-2] * 4, *[3e-3] * 3, 0.1])

    def lines(self, x: Array) -> tuple[Array, Array]:
        """Directions and points (..., 3) of the axes that unknowns (..., 10) mean."""
        return _frame(self.start, x)[0], self.middle + x[..., 2:4] @ make_tangent_basis(self.start)

    def line(self, x: Array) -> Line:
        """Axis that the unknowns mean."""
        return Line(
            axis=_frame(self.start, x)[0], point=self.middle + x[2:4] @ make_tangent_basis(self.start)
        )

    def about(self, x: Array) -> tuple["Revolute", Array]:
        """The same model and unknowns, tilts counted from the axis that they mean."""
        line = self.line(x)
        offset = line.point - self.middle
        turned = x.copy()
        turned[:2] = 0.0
        turned[2:4] = make_tangent_basis(line.axis) @ offset
        turned[5] += offset @ line.axis
        return replace(self, start=line.axis), turned

    def grasp(self, x: Array) -> Array:
        """Held point (..., 3), end-effector frame, [m]."""
        return self.path.hold.point_ee + x[..., 6:9]

    def values(self, x: Array) -> Array:
        """Turn of the part (K,) since the first node, [rad]."""
        return self._rolled(x)[2]

    def data(self, x: Array) -> Array:
        """Residuals (..., 5, K) in the order of `kinds`, [m] or [rad], of unknowns (..., 10)."""
        radii, heights, angles = self._rolled(x)
        axis, first, second = (self.turns_world @ unit[..., None] for unit in _frame(self.start, x))
        uneven = axis[..., 0] - x[..., 9:] * angles
        rows = [radii - x[..., 4:5], heights - x[..., 5:6], first[..., 0], second[..., 0], uneven]
        return np.stack(rows, axis=-2)

    def _rolled(self, x: Array) -> tuple[Array, Array, Array]:
        """Distance from the axis, height along it and angle about it (..., K) of the held point."""
        Ts = self.path.Ts_world_ee
        held = self.grasp(x)[..., None, :, None]
        points = (Ts[:, :3, :3] @ held)[..., 0] + Ts[:, :3, 3]
        offsets = points - (self.middle + x[..., 2:4] @ make_tangent_basis(self.start))[..., None, :]
        heights, along, across = ((offsets @ unit[..., None])[..., 0] for unit in _frame(self.start, x))
        angles = np.unwrap(np.arctan2(across, along))
        return np.hypot(along, across), heights, angles - angles[..., :1]

    def first(self) -> Array:
        """First unknowns (10,): an algebraic circle."""
        tangents = make_tangent_basis(self.start)
        turns = self.turns_world @ self.start
        center, radius = fit_circle(self.path.points_world, self.middle, tangents, turns)
        return np.array([0, 0, *center, radius, 0, 0, 0, 0, RATIO], np.float64)

    def beliefs(self, x: Array) -> Array:
        """Residuals (..., 6) of what is assumed beforehand, in standard deviations."""
        ratio = (x[..., 9:] - RATIO) / RATIO_SD
        radius = np.maximum(np.abs(x[..., 4:5]), 1e-3)
        size = np.log(radius / RADIUS_M) / RADIUS_SPREAD
        beyond = np.log(np.maximum(radius / self.reach_m, 1.0)) / REACH_SPREAD
        return np.concatenate([x[..., 6:9] / self.path.hold.sd_m, ratio, size, beyond], axis=-1)

    def log_any_place(self, x: Array) -> float:
        """Log density of an axis' place of which only the usual size is known, see `beliefs`."""
        return -float(np.log(2 * np.pi * x[4] ** 2) + np.log(RADIUS_SPREAD * np.sqrt(2 * np.pi)))

    @property
    def log_beliefs(self) -> float:
        """Normalization of `beliefs`."""
        return -float(np.log(self.path.hold.sd_m) * 3 + np.log(RATIO_SD) + 2 * np.log(2 * np.pi))


@dataclass(frozen=True, slots=True, kw_only=True)
class Prismatic:
    """The held point goes straight and the hand does not turn.

    Fingers hold the part in the direction in which they close, and it slips along their pads. So a path
    strays less along the closing direction, as far as that is across the way, than across it.

    Unknowns (4,): tilt of the axis against `start` (2), place of the line across `start` from `middle` (2).
    """

    path: EePath
    turns_world: Array
    start: Array
    middle: Array

    kinds = ("straight", "bar", "tilt", "tilt", "tilt")
    steps = np.array([1e-2, 1e-2, 1e-2, 1e-2])

    @property
    def firmness(self) -> float:
        """Share of the closing direction in the direction of the first row of `data`, squared."""
        across = make_tangent_basis(self.start) @ self.path.closing_world
        return float(across @ across)

    def lines(self, x: Array) -> tuple[Array, Array]:
        """Directions and points (..., 3) of the lines that unknowns (..., 4) mean."""
        return _frame(self.start, x)[0], self.middle + x[..., 2:4] @ make_tangent_basis(self.start)

    def line(self, x: Array) -> Line:
        """Line that the unknowns mean."""
        return Line(
            axis=_frame(self.start, x)[0], point=self.middle + x[2:4] @ make_tangent_basis(self.start)
        )

    def about(self, x: Array) -> tuple["Prismatic", Array]:
        """The same model and unknowns, tilts counted from the axis that they mean."""
        line = self.line(x)
        place = make_tangent_basis(line.axis) @ (line.point - self.middle)
        return replace(self, start=line.axis), np.concatenate([np.zeros(2), place])

    def grasp(self, x: Array) -> Array:
        """Held point (3,), end-effector frame, [m]; a straight path does not tell it."""
        del x
        return self.path.hold.point_ee

    def values(self, x: Array) -> Array:
        """Travel of the part (K,) since the first node, [m]."""
        points = self.path.points_world
        return (points - points[0]) @ self.line(x).axis

    def data(self, x: Array) -> Array:
        """Residuals (..., 5, K) in the order of `kinds`, [m] or [rad], of unknowns (..., 4)."""
        place = self.middle + x[..., 2:4] @ make_tangent_basis(self.start)
        offsets = self.path.points_world - place[..., None, :]
        first, second = ((offsets @ unit[..., None])[..., 0] for unit in _frame(self.start, x)[1:])
        across = make_tangent_basis(self.start) @ self.path.closing_world
        c, s = across / max(float(np.linalg.norm(across)), 1e-9)
        c, s = (c, s) if c or s else (1.0, 0.0)
        rows = [c * first + s * second, c * second - s * first]
        turns = np.broadcast_to(self.turns_world.T, (*x.shape[:-1], 3, len(self.turns_world)))
        return np.concatenate([np.stack(rows, axis=-2), turns], axis=-2)

    def first(self) -> Array:
        """First unknowns (4,)."""
        return np.zeros(4)

    def beliefs(self, x: Array) -> Array:
        """Nothing is assumed beforehand."""
        return np.zeros((*x.shape[:-1], 0))

    def log_any_place(self, x: Array) -> float:
        """A straight path has no place."""
        del x
        return 0.0

    @property
    def log_beliefs(self) -> float:
        """Normalization of `beliefs`."""
        return 0.0


def _frame(start: Array, x: Array) -> tuple[Array, Array, Array]:
    """Axis that tilts `x[..., :2]` make of `start` (3,), and two units (..., 3) across it that follow."""
    tangents = make_tangent_basis(start)
    axis = start + x[..., :2] @ tangents
    axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    first = tangents[0] - (axis @ tangents[0])[..., None] * axis
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return axis, first, _cross(axis, first)


def make_tangent_basis(axis: Array) -> Array:
    """Two unit vectors (2, 3) that complete a unit vector (3,) to a right-handed frame."""
    first = _cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    return np.stack([first, _cross(axis, first)])


def _cross(a: Array, b: Array) -> Array:
    """Cross product (..., 3); several times faster on few vectors than numpy's."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def guess_axes(path: EePath, turns_world: Array) -> list[Array]:
    """Rotation axis of the hand, and four directions across the path's chord.

    A short or unsteady arc hardly tells its plane, so its plane is not trusted.
    """
    points = path.points_world
    axes = []
    if np.linalg.norm(turns_world, axis=1).max() > np.radians(3.0):
        axes.append(np.linalg.svd(turns_world)[2][0])
    _, _, (_, second, third) = np.linalg.svd(points - points.mean(0))
    diagonals = np.array([third + second, third - second]) / np.sqrt(2)
    return [*axes, third, second, *diagonals]


def fit_circle(points: Array, middle: Array, tangents: Array, turns: Array) -> tuple[Array, float]:
    """Algebraic circle in the plane of the tangents: centre (2,) relative to `middle`, radius, [m].

    Source: Kasa, 1976. A nearly straight path gets a circle whose arc equals the hand's turn.
    """
    flat = (points - middle) @ tangents.T
    A = np.column_stack([2 * flat, np.ones(len(flat))])
    (x, y, c), *_ = np.linalg.lstsq(A, (flat**2).sum(1), rcond=None)
    radius = float(np.sqrt(max(c + x * x + y * y, 1e-12)))
    if radius < MAX_RADIUS_M:
        return np.array([x, y]), radius
    chord = flat[-1] - flat[0]
    length = float(np.linalg.norm(chord))
    turn = float(turns[-1] - turns[0])
    radius = float(np.clip(length / max(abs(turn), 0.05), MIN_RADIUS_M, MAX_RADIUS_M))
    side = np.array([-chord[1], chord[0]]) / max(length, 1e-9) * (1.0 if turn >= 0 else -1.0)
    return radius * side, radius
