"""Boxes that cover meshes, for assets that bring no box colliders of their own."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from aomgen.core.asset import BoxCollider
from aomgen.core.mesh import Mesh, face_normals_areas
from aomgen.core.transforms import transform
from aomgen.core.values import Array

# A component that fills its bounding box by this share is that box.
SOLID_SHARE = 0.6
# Cells along the longest edge of a hollow component, and their bounds, [m].
CELLS = 40
CELL_RANGE = (0.006, 0.03)
# Components thinner than this in two directions, [m], never need cells.
ROD_THICKNESS = 0.02


def box_cover(meshes: Sequence[Mesh]) -> list[BoxCollider]:
    """Axis-aligned boxes that cover the surface of meshes and leave hollows hollow.

    Each connected component that fills its bounding box, or is a rod or plate, becomes that
    box; others are filled with cells along their surface, merged into as few boxes as a greedy
    sweep finds. Thin walls become at most one cell thicker than they are.
    """
    boxes: list[BoxCollider] = []
    for mesh in meshes:
        for triangles in components(mesh):
            found = [_bounds(triangles)] if _is_box_like(triangles) else _cells(triangles)
            for lower, upper in found:
                half = np.maximum((upper - lower) / 2, 5e-4)
                pose = transform(np.eye(3), (lower + upper) / 2)
                boxes.append(
                    BoxCollider(name=f"{mesh.name}_{len(boxes)}", T_asset_box=pose, half_extents=half)
                )
    return boxes


def components(mesh: Mesh) -> list[Array]:
    """Triangles (F, 3, 3) of every connected component, vertices joined where they coincide."""
    keys = np.round(mesh.vertices / 1e-5).astype(np.int64)
    _, merged = np.unique(keys, axis=0, return_inverse=True)
    faces = merged.reshape(-1)[mesh.faces]
    links = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    size = int(faces.max()) + 1
    graph = coo_matrix((np.ones(len(links)), links.T), shape=(size, size))
    _, labels = connected_components(graph, directed=False)
    owners = labels[faces[:, 0]]
    return [mesh.vertices[mesh.faces[owners == label]] for label in np.unique(owners)]


def _bounds(triangles: Array) -> tuple[Array, Array]:
    return triangles.min((0, 1)), triangles.max((0, 1))


def _is_box_like(triangles: Array) -> bool:
    lower, upper = _bounds(triangles)
    size = np.sort(upper - lower)
    if size[1] < ROD_THICKNESS or size[0] < 2e-3:
        return True
    centred = triangles - triangles.mean((0, 1))
    volume = abs(np.einsum("ni,ni->n", centred[:, 0], np.cross(centred[:, 1], centred[:, 2])).sum()) / 6
    return volume >= SOLID_SHARE * float(np.prod(size))


def _cells(triangles: Array) -> list[tuple[Array, Array]]:
    """Merged surface cells as (lower, upper) corners."""
    lower, upper = _bounds(triangles)
    cell = float(np.clip((upper - lower).max() / CELLS, *CELL_RANGE))
    shape = np.maximum(np.ceil((upper - lower) / cell - 1e-6).astype(int), 1)
    step = (upper - lower) / shape
    points = _dense_points(triangles, 0.4 * cell)
    # Points on a cell's border belong to the cell nearer to the middle, so that walls stay inside.
    index = np.clip(np.floor((points - lower) / np.maximum(step, 1e-9)).astype(int), 0, shape - 1)
    filled = np.zeros(shape, bool)
    filled[tuple(index.T)] = True
    return [(lower + a * step, lower + b * step) for a, b in _merged(filled)]


def _dense_points(triangles: Array, spacing: float) -> Array:
    """Points on triangles, about `spacing` apart, on a regular barycentric grid."""
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    _, areas = face_normals_areas(triangles.reshape(-1, 3), faces)
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, 1), axis=2).max(1)
    steps = np.clip(np.ceil(edges / spacing).astype(int), 1, 400)
    points = []
    for n in np.unique(steps[areas > 0]):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        keep = i + j <= n
        weights = np.stack([i[keep], j[keep], n - i[keep] - j[keep]], 1) / n
        points.append(np.einsum("wk,fkd->fwd", weights, triangles[(steps == n) & (areas > 0)]).reshape(-1, 3))
    return np.concatenate(points)


def _merged(filled: NDArray[np.bool_]) -> list[tuple[Array, Array]]:
    """Cover of the filled cells by blocks, each grown greedily from its first free cell."""
    free, blocks = filled.copy(), []
    while free.any():
        start = np.array(np.unravel_index(np.argmax(free), free.shape))
        end = start + 1
        for axis in np.argsort(-np.array(free.shape)):
            while end[axis] < free.shape[axis]:
                window = [slice(a, b) for a, b in zip(start, end, strict=True)]
                window[axis] = slice(end[axis], end[axis] + 1)
                if not free[tuple(window)].all():
                    break
                end[axis] += 1
        free[tuple(slice(a, b) for a, b in zip(start, end, strict=True))] = False
        blocks.append((start.astype(np.float64), end.astype(np.float64)))
    return blocks
