"""The plane that most of some points lie on."""

import numpy as np

from aomgen.core.values import Array

# Points that vote at most: bounds memory; a plane that holds a hundredth of them is still told from chance.
_VOTERS = 8000
# Rounds of least squares on the points near the plane; they change little after these.
_ROUNDS = 3


def fit_plane(
    points: Array,
    tolerance: float,
    rng: np.random.Generator,
    trials: int,
    *,
    axis: Array | None = None,
    max_tilt_deg: float = 90.0,
) -> tuple[Array, Array] | None:
    """Unit normal (3,) and a point (3,) of the plane that most points (N, 3) are near; None when no trial gives one.

    Args:
        tolerance: Distance of a point that lies on the plane.
        trials: Triples of points tried.
        axis: Unit vector (3,) that the normal points along, if there is one ...
        max_tilt_deg: ... up to this angle, [deg].

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
