"""Boxes that cover meshes, for assets that bring no box colliders of their own."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from aomgen.assets.convex_parts import depth_in_hull, extract_closed_surface, fit_box, is_sheet, split_convex
from aomgen.core.asset import BoxCollider
from aomgen.core.mesh import Mesh, face_normals_areas
from aomgen.core.values import Array

# A surface of which this share, [%], lies no deeper than this below its hull, [m], is convex.
MOST_SURFACE, SHALLOW_M = 95.0, 0.003
# Points along the longest edge of a component at which its depth below the hull is measured.
SURFACE_STEPS = 40
# A face with a normal this near to an axis is aligned, and a surface with this share of aligned faces straight.
ALIGNED, STRAIGHT_SHARE = 0.999, 0.9
# A straight surface of more cells than this has curved edges, and convex parts describe it better.
MAX_CELLS = 60
# Cells along the longest edge of a hollow component, and bounds of their size, [m]: boards are hardly thinner, gaps
# for a gripper not narrower.
CELLS, CELL_RANGE = 40, (0.006, 0.03)
# More different vertex coordinates than this along an axis mean a curved surface.
MAX_PLANES = 60
# Samples are moved this far below the surface, [m]: far less than a board is thick, far more than rounding.
BELOW_SURFACE = 2e-4
# Components thinner than this in two directions, or in one, [m], are a rod or a plate.
ROD_THICKNESS, PLATE_THICKNESS = 0.02, 0.002


def box_cover(meshes: Sequence[Mesh]) -> list[BoxCollider]:
    """Boxes that cover the surface of meshes and leave hollows hollow, named after the meshes.

    Each connected component that is nearly convex becomes the box around it, oriented where that is
    smaller. Straight furniture is met exactly by cells between its planes, other closed surfaces are
    split into convex parts, and other open ones are covered by cells along their surface.
    """
    boxes: list[BoxCollider] = []
    for mesh in meshes:
        owners = face_components(mesh)
        for label in np.unique(owners):
            for points in _split(mesh.vertices[mesh.faces[owners == label]]):
                pose, half = fit_box(points)
                boxes.append(
                    BoxCollider(name=f"{mesh.name}_{len(boxes)}", T_asset_box=pose, half_extents=half)
                )
    return boxes


def _split(triangles: Array) -> list[Array]:
    """Points (N, 3) of each part that one box stands for."""
    corners = triangles.reshape(-1, 3)
    if _is_nearly_convex(triangles):
        return [corners]
    surface = extract_closed_surface(triangles)
    if is_sheet(surface):
        return [corners]
    aligned = np.abs(surface.face_normals).max(1) > ALIGNED
    straight = surface.area_faces[aligned].sum() >= STRAIGHT_SHARE * surface.area
    if surface.is_watertight and not straight:
        return split_convex(surface)
    cells = [np.stack(cell) for cell in _cells(triangles)]
    return split_convex(surface) if surface.is_watertight and len(cells) > MAX_CELLS else cells


def _is_nearly_convex(triangles: Array) -> bool:
    """Return whether the surface follows its convex hull, or is a rod or plate."""
    corners = triangles.reshape(-1, 3)
    size = np.sort(np.ptp(corners, axis=0))
    if size[1] < ROD_THICKNESS or size[0] < PLATE_THICKNESS:
        return True
    inside = depth_in_hull(corners, _dense_points(triangles, size[2] / SURFACE_STEPS))
    return float(np.percentile(inside, MOST_SURFACE)) <= SHALLOW_M


def face_components(mesh: Mesh) -> NDArray[np.int32]:
    """Number of the connected component of every face (F,), vertices joined where they coincide."""
    keys = np.round(mesh.vertices / 1e-5).astype(np.int64)
    _, merged = np.unique(keys, axis=0, return_inverse=True)
    faces = merged.reshape(-1)[mesh.faces]
    links = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    size = int(faces.max()) + 1
    graph = coo_matrix((np.ones(len(links)), links.T), shape=(size, size))
    _, labels = connected_components(graph, directed=False)
    return labels[faces[:, 0]]


def _cells(triangles: Array) -> list[tuple[Array, Array]]:
    """Surface cells merged into blocks, as (lower, upper) corners.

    Cells end where vertices lie, so that boards and panels are met exactly.
    """
    lower, upper = triangles.min((0, 1)), triangles.max((0, 1))
    cell = float(np.clip((upper - lower).max() / CELLS, *CELL_RANGE))
    planes = [_planes(triangles[..., axis].ravel(), cell) for axis in range(3)]
    points = _dense_points(triangles, 0.4 * cell)
    shape = tuple(len(p) - 1 for p in planes)
    # Points were moved a little below the surface, so that each falls into the cell behind it.
    index = tuple(
        np.clip(np.searchsorted(plane, points[:, axis]) - 1, 0, shape[axis] - 1)
        for axis, plane in enumerate(planes)
    )
    filled = np.zeros(shape, bool)
    filled[index] = True
    # A block is shrunk to the surface inside it, so that what is thinner than a cell stays thin.
    low, high = np.full((*shape, 3), np.inf), np.full((*shape, 3), -np.inf)
    np.minimum.at(low, index, points - BELOW_SURFACE)
    np.maximum.at(high, index, points + BELOW_SURFACE)
    return [
        (low[block].reshape(-1, 3).min(0), high[block].reshape(-1, 3).max(0))
        for block in _merge_cells(filled)
    ]


def _planes(coordinates: Array, cell: float) -> Array:
    """Borders of the cells along one axis: where many vertices lie, or else evenly spaced."""
    values = np.unique(np.round(coordinates / 1e-7)) * 1e-7
    values = values[np.concatenate([[True], np.diff(values) > 1e-3])]
    if len(values) > MAX_PLANES or len(values) < 2:
        low, high = float(coordinates.min()), float(coordinates.max())
        count = max(2, int((high - low) / cell) + 2)
        return np.asarray(np.linspace(low, max(high, low + 1e-3), count), np.float64)
    parts = [np.linspace(a, b, int((b - a) / (2 * cell)) + 2)[:-1] for a, b in pairwise(values)]
    return np.asarray(np.concatenate([*parts, values[-1:]]), np.float64)


def _dense_points(triangles: Array, spacing: float) -> Array:
    """Points just below triangles, about `spacing` apart, on a regular barycentric grid."""
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    normals, areas = face_normals_areas(triangles.reshape(-1, 3), faces)
    inwards = triangles.mean(1, keepdims=True) - triangles
    inwards /= np.maximum(np.linalg.norm(inwards, axis=2, keepdims=True), 1e-12)
    # Also away from the triangle's edges, which are borders of cells.
    triangles = triangles - BELOW_SURFACE * normals[:, None] + 2 * BELOW_SURFACE * inwards
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, 1), axis=2).max(1)
    steps = np.clip(np.ceil(edges / spacing).astype(int), 1, 400)
    points = []
    for n in np.unique(steps[areas > 0]):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        keep = i + j <= n
        weights = np.stack([i[keep], j[keep], n - i[keep] - j[keep]], 1) / n
        points.append(np.einsum("wk,fkd->fwd", weights, triangles[(steps == n) & (areas > 0)]).reshape(-1, 3))
    return np.concatenate(points)


def _merge_cells(filled: NDArray[np.bool_]) -> list[tuple[slice, ...]]:
    """Cover of the filled cells by blocks (index slices), each grown greedily from its first free cell."""
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
        block = tuple(slice(int(a), int(b)) for a, b in zip(start, end, strict=True))
        free[block] = False
        blocks.append(block)
    return blocks
