"""Oriented boxes around points, and planes through them."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar

from aomgen.core.transforms import apply, transform
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays
from aomgen.errors import InputError

# Quantiles of the points between which a box extends, so that outliers do not enlarge it.
QUANTILES = (0.01, 0.99)
# Quantiles that are used to find the yaw of the footprint; handles are up to 2 % of the points.
FOOTPRINT_QUANTILES = (0.02, 0.98)
# Smallest number of points that define a box.
MIN_POINTS = 20
# Largest number of points that are counted for each plane hypothesis, which bounds the memory; a plane that contains a
# hundredth of them is still significant.
_VOTERS = 8000
# Number of least-squares iterations on the points near the plane; further iterations change little.
_ROUNDS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class OrientedBox:
    """A box with arbitrary orientation.

    Attributes:
        T_world_box: Pose of the box (4, 4): center and axes.
        half_extents: Half extents (3,), [m].
    """

    T_world_box: Matrix4
    half_extents: Vector3

    __post_init__ = freeze_arrays

    @property
    def diagonal_m(self) -> float:
        """Length of the space diagonal, [m]."""
        return float(2 * np.linalg.norm(self.half_extents))

    def coordinates(self, points_world: ArrayLike) -> Array:
        """Compute the coordinates (N, 3) of points (N, 3), world frame, in the box's frame, [m]."""
        R, center = self.T_world_box[:3, :3], self.T_world_box[:3, 3]
        return np.asarray(points_world, np.float64) @ R - center @ R

    def corners(self) -> Array:
        """Compute the corners (8, 3), world frame, [m]."""
        return apply(self.T_world_box, np.array(list(product((-1.0, 1.0), repeat=3))) * self.half_extents)

    def edges(self) -> Array:
        """Compute the end points (12, 2, 3) of the twelve edges, world frame, [m]."""
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
        """List the planes `normal @ x = offset` of the six faces, world frame; all normals are in positive axis directions."""
        normals, centers = self.T_world_box[:3, :3].T, self.T_world_box[:3, 3] @ self.T_world_box[:3, :3]
        return [
            (normal, float(center + side))
            for normal, center, half in zip(normals, centers, self.half_extents, strict=True)
            for side in (-half, half)
        ]


def fit_box(points_world: ArrayLike, R_world_box: Array) -> OrientedBox:
    """Fit a box with given axes (3, 3) to points (N, 3), [m]; points beyond `QUANTILES` are ignored.

    Raises:
        InputError: There are fewer than 20 points.
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
    """Find the axes (3, 3), z up, of the upright box with the smallest base around points (N, 2) or (N, 3).

    The yaw is in 0..pi/2.
    """
    xy = np.asarray(points_world, np.float64)[:, :2]

    def area(yaw: float) -> float:
        low, high = np.quantile(xy @ upright_axes(yaw)[:2, :2], FOOTPRINT_QUANTILES, axis=0)
        return float(np.prod(high - low))

    step = np.pi / 180
    coarse = min(np.arange(90) * step, key=area)
    fine = minimize_scalar(area, bounds=(coarse - step, coarse + step), method="bounded").x
    return upright_axes(min((coarse, float(fine)), key=area) % (np.pi / 2))


def upright_axes(yaw: float) -> Array:
    """Return the axes (3, 3) after a rotation about the vertical by `yaw`, [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def fit_plane(
    points: Array,
    tolerance: float,
    rng: np.random.Generator,
    trials: int,
    *,
    axis: Array | None = None,
    max_tilt_deg: float = 90.0,
) -> tuple[Array, Array] | None:
    """Fit the plane that contains most of the points (N, 3) within a tolerance.

    Args:
        points: Points (N, 3).
        tolerance: Largest distance of an inlier from the plane, in the unit of the points.
        rng: Generator that selects the triples.
        trials: Number of triples of points that are tested.
        axis: Approximate direction of the normal (3,), a unit vector; None for any direction.
        max_tilt_deg: Largest angle between normal and `axis`, [deg].

    Returns:
        Unit normal (3,) and a point (3,) on the plane; None if no triple gives a plane.

    Source: RANSAC (Fischler & Bolles, 1981), then least squares on the inliers.
    """
    triples = points[rng.integers(0, len(points), (trials, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, anchors = normals[lengths > 0] / lengths[lengths > 0, None], triples[lengths > 0, 0]
    if axis is not None:
        usable = np.abs(normals @ axis) > np.cos(np.radians(max_tilt_deg))
        normals, anchors = normals[usable], anchors[usable]
    if not len(normals):
        return None
    voters = points if len(points) <= _VOTERS else points[rng.permutation(len(points))[:_VOTERS]]
    offsets = (normals * anchors).sum(1)
    best = int((np.abs(voters @ normals.T - offsets) < tolerance).sum(0).argmax())
    normal, center = normals[best], anchors[best]
    near = np.abs(points @ normal - offsets[best]) < tolerance
    for _ in range(_ROUNDS):
        if near.sum() < 3:
            break
        center = points[near].mean(0)
        normal = np.linalg.svd(points[near] - center, full_matrices=False)[2][2]
        near = np.abs((points - center) @ normal) < tolerance
    return (normal if axis is None else normal * np.sign(normal @ axis)), center
