"""Direction of gravity in the structure's frame, from the cameras and the large planes of the scene."""

import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.planes import find_plane
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
        plane, members = find_plane(left, 0.01 * extent, rng, mean_up)
        normal = plane.normal * np.sign(plane.normal @ mean_up)
        near = np.abs(plane.heights(left)) < 0.02 * extent
        if not members.any() or near.sum() < 0.03 * len(points_recon):
            break
        if all(normal @ up < np.cos(np.radians(2.0)) for up in ups):
            ups.append(normal)
        left = left[~near]
    return [*ups, mean_up]
