"""Sharp edges of a mesh, where discs must be narrow to keep the outline crisp."""

import numpy as np
from numpy.typing import NDArray

from aomgen.core.mesh import face_normals_areas
from aomgen.core.values import Array

# Two faces that turn by more than this meet in a crease.
CREASE_COSINE = float(np.cos(np.deg2rad(30.0)))


def crease_edges(vertices: Array, faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which edges (F, 3) of the faces are creases or borders; edge k joins corners k and k + 1.

    Vertices at the same place count as one, because exporters split them at seams.
    """
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-9)
    _, merged = np.unique(np.round(vertices / (size * 1e-6)).astype(np.int64), axis=0, return_inverse=True)
    corners = merged.reshape(-1)[faces]
    pairs = np.sort(np.stack([corners, np.roll(corners, -1, 1)], -1).reshape(-1, 2), 1)
    _, edge_ids, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    edge_ids = edge_ids.reshape(-1)
    normals, _ = face_normals_areas(vertices, faces)
    owners = np.repeat(np.arange(len(faces)), 3)
    # Length of the sum of the unit normals at an edge tells the angle between two of them.
    total = np.zeros((len(counts), 3))
    np.add.at(total, edge_ids, normals[owners])
    flat = (counts == 2) & (np.linalg.norm(total, axis=1) > np.sqrt(2 + 2 * CREASE_COSINE))
    return ~flat[edge_ids].reshape(-1, 3)


def crease_distances(
    vertices: Array, faces: NDArray[np.int64], face_ids: NDArray[np.int64], points: Array
) -> tuple[Array, Array]:
    """Distance (N,) of points on faces to the nearest crease of their own face, and its direction.

    Returns:
        Distances, infinite without a crease, and unit directions (N, 3) in the surface, across
        the crease (any tangent without one).
    """
    creased = crease_edges(vertices, faces)[face_ids]
    normals, _ = face_normals_areas(vertices, faces)
    corners = vertices[faces[face_ids]]
    along = np.roll(corners, -1, 1) - corners
    along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-30)
    across = np.cross(normals[face_ids][:, None], along)
    distances = np.abs(np.einsum("nkd,nkd->nk", points[:, None] - corners, across))
    distances = np.where(creased, distances, np.inf)
    nearest = distances.argmin(1)
    rows = np.arange(len(points))
    return distances[rows, nearest], across[rows, nearest]
