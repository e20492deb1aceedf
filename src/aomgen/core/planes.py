"""Planes among points."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array, freeze

# Triples tried: with a fifth of inliers a good one is missed with a probability of 3e-4, with a third never.
TRIALS = 1000
# Points that vote for a triple: the share of inliers is then known to 1 %.
VOTERS = 2000
# Normals may be this far from a wanted direction: cosine of 30 degrees.
MIN_COSINE = 0.866


@dataclass(frozen=True, slots=True, kw_only=True)
class Plane:
    """Points x with `normal @ x = offset`; the normal (3,) has unit length."""

    normal: Array
    offset: float

    def __post_init__(self) -> None:
        freeze(self, "normal", self.normal, (3,))

    def heights(self, points: Array) -> Array:
        """Signed distances (N,) of points (N, 3)."""
        return points @ self.normal - self.offset


def fit_plane(points: Array) -> Plane:
    """Least squares through points (N, 3), N >= 3."""
    center = points.mean(0)
    normal = np.linalg.svd(points - center, full_matrices=False)[2][2]
    return Plane(normal=normal, offset=float(normal @ center))


def find_plane(
    points: Array, tolerance: float, rng: np.random.Generator, direction: Array | None = None
) -> tuple[Plane, NDArray[np.bool_]]:
    """The plane that most points (N, 3) lie on, N >= 3, and which of them (N,) do.

    Args:
        points: Any frame.
        tolerance: Largest distance of a point that lies on the plane.
        rng: Chooses triples and voters.
        direction: Unit vector (3,) that the normal is within 30 degrees of, either way; None for any.

    Source: RANSAC (Fischler & Bolles, 1981), then least squares on the inliers.
    """
    corners = points[rng.integers(len(points), size=(TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(lengths, 1e-12)[:, None]
    offsets = (normals * corners[:, 0]).sum(1)
    voters = points[rng.permutation(len(points))[:VOTERS]]
    votes = (np.abs(voters @ normals.T - offsets) < tolerance).sum(0)
    # A triple that holds a point twice is no plane.
    votes[lengths < 1e-12] = 0
    if direction is not None:
        votes[np.abs(normals @ direction) < MIN_COSINE] = 0
    best = int(np.argmax(votes))
    plane = Plane(normal=normals[best], offset=float(offsets[best]))
    members = (np.abs(plane.heights(points)) < tolerance) & (votes[best] > 0)
    for _ in range(3):
        if members.sum() < 3:
            break
        plane = fit_plane(points[members])
        members = np.abs(plane.heights(points)) < tolerance
    return plane, members
