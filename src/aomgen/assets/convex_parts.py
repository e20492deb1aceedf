"""Convex parts of closed surfaces, and the oriented boxes that stand for them."""

from typing import Final

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from aomgen.core.transforms import transform
from aomgen.core.values import Array

# Depth of a hollow that is left filled, as a share of the longest side, and its bounds, [m]: a handle is met to
# millimetres, a cabinet to centimetres.
CONCAVITY, CONCAVITY_RANGE = 0.015, (0.003, 0.02)
# More parts than this slow down the simulation; furniture has some 20.
MAX_PARTS: Final = 40
# Search effort of CoACD: half of its default finds the boards of furniture as well.
SEARCH_ITERATIONS, SAMPLING = 60, 1000
# An oriented box is preferred to one along the axes where it is smaller than this share of it.
SMALLER: Final = 0.9
# Knobs lack their back, and some handles a triangle: a surface with fewer open edges than this share of its faces is
# closed. One with more, and no thicker than this, [m], is a moulding.
LOOSE_SHARE, SHEET_M = 0.15, 0.06
# Least half thickness of a box, [m].
LEAST_HALF_M: Final = 5e-4
# Points that lie this near to one plane have no hull, [m].
FLAT_M: Final = 1e-5


def extract_closed_surface(triangles: Array) -> trimesh.Trimesh:
    """The surface of triangles (F, 3, 3), drawn from one side, outward, and closed where little of it is open."""
    corners = triangles.reshape(-1, 3)
    surface = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    surface.merge_vertices(digits_vertex=5)
    surface.update_faces(surface.unique_faces() & surface.nondegenerate_faces())
    if 0 < len(_loose_edges(surface)) <= LOOSE_SHARE * len(surface.faces):
        surface = _cap(surface)
    trimesh.repair.fix_normals(surface)
    return surface


def is_sheet(surface: trimesh.Trimesh) -> bool:
    """Return whether a surface is a thin sheet without a back, as mouldings on a door are."""
    open_share = len(_loose_edges(surface)) / len(surface.faces)
    return open_share > LOOSE_SHARE and float(surface.extents.min()) <= SHEET_M


def _loose_edges(surface: trimesh.Trimesh) -> NDArray[np.int64]:
    """Vertex pairs (E, 2) of the edges that belong to one face."""
    edges, counts = np.unique(surface.edges_sorted, axis=0, return_counts=True)
    return edges[counts == 1]


def _cap(surface: trimesh.Trimesh) -> trimesh.Trimesh:
    """The surface with every loop of open edges closed by a fan about its middle."""
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
    """Corner points (V, 3) of convex parts that make up a closed surface.

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
    """Pose (4, 4) and half extents (3,) of a small box around points (N, 3), along the axes where that is small enough."""
    low, high = points.min(0), points.max(0)
    half = np.maximum((high - low) / 2, LEAST_HALF_M)
    straight = transform(np.eye(3), (low + high) / 2), np.asarray(half, np.float64)
    # Flat points have no hull, and two of them are the corners of a cell.
    if len(points) < 4 or np.linalg.svd(points - points.mean(0), compute_uv=False)[-1] < FLAT_M:
        return straight
    T_box_points, extents = trimesh.bounds.oriented_bounds(points)
    turned = np.maximum(np.asarray(extents) / 2, LEAST_HALF_M)
    if not turned.prod() < SMALLER * half.prod():
        return straight
    return np.asarray(np.linalg.inv(T_box_points), np.float64), np.asarray(turned, np.float64)


def depth_in_hull(points: Array, samples: Array) -> Array:
    """Depths (S,) of samples (S, 3) below the convex hull of points (N, 3), [m]; zeros where these are flat."""
    try:
        hull = ConvexHull(points)
    except QhullError:
        return np.zeros(len(samples))
    return -(samples @ hull.equations[:, :3].T + hull.equations[:, 3]).max(1)
