"""Direction of gravity in the structure's frame, from the cameras and the large planes of the scene."""

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.values import Array


def up_candidates(
    cameras_recon: list[Camera], points_recon: Array, rng: np.random.Generator, count: int = 2
) -> list[Array]:
    """Likely up directions (3,) in the recon frame, best first.

    People hold cameras upright, so up lies near the mean of the cameras' own; the large planes of
    the scene (table, floor) sharpen it. Planes tilted more than 30 degrees from it are walls.

    Args:
        cameras_recon: Scan cameras.
        points_recon: Sparse or dense points (P, 3).
        rng: Chooses the triples of the plane search.
        count: How many plane normals to return before the plain mean.
    """
    mean_up = -np.mean([camera.T_world_cam[:3, 1] for camera in cameras_recon], 0)
    mean_up /= np.linalg.norm(mean_up)
    ups: list[Array] = []
    left = np.asarray(points_recon, np.float64)
    extent = np.median(np.linalg.norm(left - np.median(left, 0), axis=1)) if len(left) else 1.0
    for _ in range(count):
        if len(left) < 50:
            break
        normal, near = _largest_plane(left, mean_up, 0.01 * extent, rng)
        if near.sum() < 0.03 * len(points_recon):
            break
        if all(normal @ up < np.cos(np.radians(2.0)) for up in ups):
            ups.append(normal)
        left = left[~near]
    return [*ups, mean_up]


def _largest_plane(
    points: Array, up: Array, tolerance: float, rng: np.random.Generator, trials: int = 1500
) -> tuple[Array, NDArray[np.bool_]]:
    """Normal (3,) towards `up` and members (P,) of the plane that most points lie on."""
    triples = points[rng.integers(0, len(points), (trials, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(lengths, 1e-12)[:, None]
    normals *= np.sign(normals @ up)[:, None]
    usable = (lengths > 1e-9) & (normals @ up > np.cos(np.radians(30.0)))
    if not usable.any():
        return up, np.zeros(len(points), bool)
    normals, anchors = normals[usable], triples[usable, 0]
    offsets = np.einsum("td,td->t", normals, anchors)
    sample = points[rng.permutation(len(points))[:2000]]
    counts = (np.abs(sample @ normals.T - offsets) < tolerance).sum(0)
    best = int(np.argmax(counts))
    normal, offset = normals[best], offsets[best]
    for _ in range(3):
        near = np.abs(points @ normal - offset) < tolerance
        if near.sum() < 3:
            break
        center = points[near].mean(0)
        normal = np.linalg.svd(points[near] - center, full_matrices=False)[2][2]
        normal *= np.sign(normal @ up)
        offset = normal @ center
    return normal, np.abs(points @ normal - offset) < 2 * tolerance
