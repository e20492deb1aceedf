"""Oriented boxes around points."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar

from aomgen.core.transforms import apply, transform
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays
from aomgen.errors import InputError

# A box lies between these quantiles of the points, so that outliers do not stretch it.
QUANTILES = (0.01, 0.99)
# Of the footprint's yaw less counts: handles are up to 2 % of the points.
FOOTPRINT_QUANTILES = (0.02, 0.98)
# Fewer points have no box.
MIN_POINTS = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class OrientedBox:
    """A box with axes of its own.

    Attributes:
        T_world_box: Centre and axes (4, 4).
        half_extents: (3,), [m].
    """

    T_world_box: Matrix4
    half_extents: Vector3

    __post_init__ = freeze_arrays

    @property
    def diagonal_m(self) -> float:
        """Length of the space diagonal, [m]."""
        return float(2 * np.linalg.norm(self.half_extents))

    def coordinates(self, points_world: ArrayLike) -> Array:
        """Points (N, 3) in the box's frame."""
        R, center = self.T_world_box[:3, :3], self.T_world_box[:3, 3]
        return np.asarray(points_world, np.float64) @ R - center @ R

    def corners(self) -> Array:
        """(8, 3), world frame, [m]."""
        return apply(self.T_world_box, np.array(list(product((-1.0, 1.0), repeat=3))) * self.half_extents)

    def edges(self) -> Array:
        """End points (12, 2, 3) of the twelve edges, world frame, [m]."""
        ends = []
        for along in range(3):
            first, second = (axis for axis in range(3) if axis != along)
            for sign_first, sign_second in product((-1.0, 1.0), repeat=2):
                corner = np.zeros(3)
                corner[first], corner[second] = sign_first, sign_second
                step = np.eye(3)[along]
                ends.append([corner - step, corner + step])
        return apply(self.T_world_box, np.array(ends) * self.half_extents)

    def faces(self) -> list[tuple[Array, float]]:
        """Planes `normal @ x = offset` of the six faces, world frame, normals along the box's axes."""
        normals, centers = self.T_world_box[:3, :3].T, self.T_world_box[:3, 3] @ self.T_world_box[:3, :3]
        return [
            (normal, float(center + side))
            for normal, center, half in zip(normals, centers, self.half_extents, strict=True)
            for side in (-half, half)
        ]


def fit_box(points_world: ArrayLike, R_world_box: Array) -> OrientedBox:
    """Box with given axes (3, 3) around points (N, 3), without those beyond `QUANTILES`.

    Raises:
        InputError: Fewer than 20 points.
    """
    points = np.asarray(points_world, np.float64)
    if not len(points) >= MIN_POINTS:
        raise InputError("part points", f"{len(points)} points, need {MIN_POINTS}", "correct the prompts")
    low, high = np.quantile(points @ R_world_box, QUANTILES, axis=0)
    return OrientedBox(
        T_world_box=transform(R_world_box, R_world_box @ ((low + high) / 2)),
        half_extents=np.maximum((high - low) / 2, 1e-4),
    )


def find_upright_axes(points_world: ArrayLike) -> Array:
    """Axes (3, 3), z up, of the upright box with the least base around points (N, 2 or more), yaw in 0..pi/2."""
    xy = np.asarray(points_world, np.float64)[:, :2]

    def area(yaw: float) -> float:
        low, high = np.quantile(xy @ upright_axes(yaw)[:2, :2], FOOTPRINT_QUANTILES, axis=0)
        return float(np.prod(high - low))

    step = np.pi / 180
    coarse = min(np.arange(90) * step, key=area)
    fine = minimize_scalar(area, bounds=(coarse - step, coarse + step), method="bounded").x
    return upright_axes(min((coarse, float(fine)), key=area) % (np.pi / 2))


def upright_axes(yaw: float) -> Array:
    """Axes (3, 3) turned about the vertical, [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
