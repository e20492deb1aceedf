"""Cover meshes with boxes, for assets without box colliders."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from aomgen.core.asset import BoxCollider
from aomgen.core.mesh import Mesh, face_normals_areas
from aomgen.core.transforms import transform
from aomgen.core.values import Array

# A surface is nearly convex if this share of it, [%], is at most this far below its convex hull, [m].
MOST_SURFACE, SHALLOW_M = 95.0, 0.003
# Number of points along the longest side of a component at which its depth below the hull is measured.
SURFACE_STEPS = 40
# A face is axis-aligned if the largest component of its unit normal exceeds the first value. A surface is rectilinear if
# axis-aligned faces cover at least the second value's share of its area.
ALIGNED, STRAIGHT_SHARE = 0.999, 0.9
# A rectilinear surface that needs more cells than this has curved edges and is split into convex parts instead.
MAX_CELLS = 60
# Number of cells along the longest side of a hollow component, and bounds of their size, [m]: few boards are thinner than
# the lower bound, and no gap for a gripper is narrower than the upper bound.
CELLS, CELL_RANGE = 40, (0.006, 0.03)
# A component with more distinct vertex coordinates than this along an axis is treated as curved.
MAX_PLANES = 60
# Samples are moved this far below the surface, [m]: much less than the thickness of a board, much more than rounding errors.
BELOW_SURFACE = 2e-4
# A component thinner than the first value in two directions is a rod; thinner than the second in one, a plate, [m].
ROD_THICKNESS, PLATE_THICKNESS = 0.02, 0.002
# Largest depth of a concavity that the cover may fill, as a share of the longest side, and its bounds, [m]: handles are
# covered with millimeter accuracy, cabinets with centimeter accuracy.
CONCAVITY, CONCAVITY_RANGE = 0.015, (0.003, 0.02)
# Largest number of convex parts, which limits the cost of simulation; furniture needs about 20.
MAX_PARTS: Final = 40
# Search effort of CoACD: half of its default is enough to separate the boards of furniture.
SEARCH_ITERATIONS, SAMPLING = 60, 1000
# An oriented box is preferred if its volume is less than this share of that of the axis-aligned box.
SMALLER: Final = 0.9
# Knobs are often modeled without a back, and some handles lack a triangle: the holes of a surface are closed if its open
# edges are at most this share of its number of faces. With more open edges, a surface at most this thick, [m], is a sheet.
LOOSE_SHARE, SHEET_M = 0.15, 0.06
# Smallest half thickness of a box, [m].
LEAST_HALF_M: Final = 5e-4
# Points whose deviation from a plane is below this are coplanar and have no hull, [m].
FLAT_M: Final = 1e-5


def box_cover(meshes: Sequence[Mesh]) -> list[BoxCollider]:
    """Cover the surface of meshes with boxes that keep cavities empty.

    A connected component that is nearly convex is covered by one box, which is oriented if that is smaller. Rectilinear
    furniture is covered exactly by cells between its planes, other closed surfaces are split into convex parts, and other
    open surfaces are covered by cells along the surface.

    Args:
        meshes: Meshes in one frame, [m].

    Returns:
        Boxes in the frame of the meshes, each named after its mesh.
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
    """Split triangles (F, 3, 3) into parts that are covered by one box each, given as points (N, 3)."""
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
    """Label every face (F,) with the number of its connected component; coincident vertices are merged."""
    keys = np.round(mesh.vertices / 1e-5).astype(np.int64)
    _, merged = np.unique(keys, axis=0, return_inverse=True)
    faces = merged.reshape(-1)[mesh.faces]
    links = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    size = int(faces.max()) + 1
    graph = coo_matrix((np.ones(len(links)), links.T), shape=(size, size))
    _, labels = connected_components(graph, directed=False)
    return labels[faces[:, 0]]


def _cells(triangles: Array) -> list[tuple[Array, Array]]:
    """Cover a surface with cells and merge them into blocks, given as (lower, upper) corners.

    Cell borders are at vertex coordinates, so that the blocks follow boards and panels exactly.
    """
    lower, upper = triangles.min((0, 1)), triangles.max((0, 1))
    cell = float(np.clip((upper - lower).max() / CELLS, *CELL_RANGE))
    planes = [_planes(triangles[..., axis].ravel(), cell) for axis in range(3)]
    points = _dense_points(triangles, 0.4 * cell)
    shape = tuple(len(p) - 1 for p in planes)
    # The points are slightly below the surface, so that each is in the cell behind it.
    index = tuple(
        np.clip(np.searchsorted(plane, points[:, axis]) - 1, 0, shape[axis] - 1)
        for axis, plane in enumerate(planes)
    )
    filled = np.zeros(shape, bool)
    filled[index] = True
    # A block is shrunk to the surface inside it, so that a part thinner than a cell keeps its thickness.
    low, high = np.full((*shape, 3), np.inf), np.full((*shape, 3), -np.inf)
    np.minimum.at(low, index, points - BELOW_SURFACE)
    np.maximum.at(high, index, points + BELOW_SURFACE)
    return [
        (low[block].reshape(-1, 3).min(0), high[block].reshape(-1, 3).max(0))
        for block in _merge_cells(filled)
    ]


def _planes(coordinates: Array, cell: float) -> Array:
    """Compute the cell borders along one axis: the vertex coordinates, or even spacing if there are too many of them."""
    values = np.unique(np.round(coordinates / 1e-7)) * 1e-7
    values = values[np.concatenate([[True], np.diff(values) > 1e-3])]
    if len(values) > MAX_PLANES or len(values) < 2:
        low, high = float(coordinates.min()), float(coordinates.max())
        count = max(2, int((high - low) / cell) + 2)
        return np.asarray(np.linspace(low, max(high, low + 1e-3), count), np.float64)
    parts = [np.linspace(a, b, int((b - a) / (2 * cell)) + 2)[:-1] for a, b in pairwise(values)]
    return np.asarray(np.concatenate([*parts, values[-1:]]), np.float64)


def _dense_points(triangles: Array, spacing: float) -> Array:
    """Sample points just below triangles on a regular barycentric grid, about `spacing` apart, [m]."""
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    normals, areas = face_normals_areas(triangles.reshape(-1, 3), faces)
    inwards = triangles.mean(1, keepdims=True) - triangles
    inwards /= np.maximum(np.linalg.norm(inwards, axis=2, keepdims=True), 1e-12)
    # Points are also moved away from the triangle's edges, which coincide with cell borders.
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
    """Cover the filled cells with blocks (index slices), each grown greedily from its first free cell."""
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


def extract_closed_surface(triangles: Array) -> trimesh.Trimesh:
    """Build a surface with outward normals from triangles (F, 3, 3); duplicate faces are removed and small holes closed."""
    corners = triangles.reshape(-1, 3)
    surface = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    surface.merge_vertices(digits_vertex=5)
    surface.update_faces(surface.unique_faces() & surface.nondegenerate_faces())
    if 0 < len(_loose_edges(surface)) <= LOOSE_SHARE * len(surface.faces):
        surface = _cap(surface)
    trimesh.repair.fix_normals(surface)
    return surface


def is_sheet(surface: trimesh.Trimesh) -> bool:
    """Return whether a surface is a thin sheet without a back, for example a molding on a door."""
    open_share = len(_loose_edges(surface)) / len(surface.faces)
    return open_share > LOOSE_SHARE and float(surface.extents.min()) <= SHEET_M


def _loose_edges(surface: trimesh.Trimesh) -> NDArray[np.int64]:
    """Return the vertex pairs (E, 2) of the open edges, which belong to one face only."""
    edges, counts = np.unique(surface.edges_sorted, axis=0, return_counts=True)
    return edges[counts == 1]


def _cap(surface: trimesh.Trimesh) -> trimesh.Trimesh:
    """Close every loop of open edges by a triangle fan around its center."""
    loose = _loose_edges(surface)
    _, labels = connected_components(
        coo_matrix((np.ones(len(loose)), loose.T), shape=[len(surface.vertices)] * 2), directed=False
    )
    loops = labels[loose[:, 0]]
    names, first = np.unique(loops, return_inverse=True)
    middles = np.array([surface.vertices[loose[loops == name]].mean((0, 1)) for name in names]).reshape(-1, 3)
    caps = np.column_stack([loose, len(surface.vertices) + first])
    return trimesh.Trimesh(
        np.concatenate([surface.vertices, middles]), np.concatenate([surface.faces, caps]), process=False
    )


def split_convex(surface: trimesh.Trimesh) -> list[Array]:
    """Split a closed surface into convex parts, given by their vertices (V, 3).

    Source: Wei et al., Approximate Convex Decomposition for 3D Meshes with Collision-Aware Concavity, 2022.
    """
    import coacd

    coacd.set_log_level("error")
    concavity = float(np.clip(CONCAVITY * surface.extents.max(), *CONCAVITY_RANGE))
    parts = coacd.run_coacd(
        coacd.Mesh(surface.vertices, surface.faces),
        threshold=concavity,
        real_metric=True,
        preprocess_mode="off",
        max_convex_hull=MAX_PARTS,
        mcts_iterations=SEARCH_ITERATIONS,
        resolution=SAMPLING,
        seed=0,
    )
    return [np.asarray(vertices, np.float64) for vertices, _ in parts]


def fit_box(points: Array) -> tuple[Array, Array]:
    """Compute the pose (4, 4) and half extents (3,), [m], of a box around points (N, 3).

    The box is axis-aligned unless an oriented one is clearly smaller.
    """
    low, high = points.min(0), points.max(0)
    half = np.maximum((high - low) / 2, LEAST_HALF_M)
    straight = transform(np.eye(3), (low + high) / 2), np.asarray(half, np.float64)
    # Coplanar points have no hull, and two points are the corners of a cell.
    if len(points) < 4 or np.linalg.svd(points - points.mean(0), compute_uv=False)[-1] < FLAT_M:
        return straight
    T_box_points, extents = trimesh.bounds.oriented_bounds(points)
    turned = np.maximum(np.asarray(extents) / 2, LEAST_HALF_M)
    if not turned.prod() < SMALLER * half.prod():
        return straight
    return np.asarray(np.linalg.inv(T_box_points), np.float64), np.asarray(turned, np.float64)


def depth_in_hull(points: Array, samples: Array) -> Array:
    """Compute the depths (S,) of samples (S, 3) below the convex hull of points (N, 3), [m]; zeros for coplanar points."""
    try:
        hull = ConvexHull(points)
    except QhullError:
        return np.zeros(len(samples))
    return -(samples @ hull.equations[:, :3].T + hull.equations[:, 3]).max(1)
