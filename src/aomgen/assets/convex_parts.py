"""Convex parts of closed surfaces, and the oriented boxes that stand for them."""

from typing import Final

import coacd
import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from aomgen.core.transforms import transform
from aomgen.core.values import Array

# Depth of a hollow that is left filled, [m]: a finger needs 12 mm behind a handle.
CONCAVITY_M: Final = 0.01
# More parts than this slow down the simulation; furniture has some 20.
MAX_PARTS: Final = 40
# Search effort of CoACD: half of its default finds the boards of furniture as well.
SEARCH_ITERATIONS, SAMPLING = 60, 1000
# An oriented box is preferred to one along the axes where it is smaller than this share of it.
SMALLER: Final = 0.9
# Least half thickness of a box, [m].
LEAST_HALF_M: Final = 5e-4
# Points that lie this near to one plane have no hull, [m].
FLAT_M: Final = 1e-5

coacd.set_log_level("error")


def split_convex(surface: trimesh.Trimesh) -> list[Array]:
    """Corner points (V, 3) of convex parts that make up a closed surface.

    Source: Wei et al., Approximate Convex Decomposition for 3D Meshes with Collision-Aware Concavity, 2022.
    """
    parts = coacd.run_coacd(
        coacd.Mesh(surface.vertices, surface.faces),
        threshold=CONCAVITY_M,
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
    straight = transform(np.eye(3), (low + high) / 2), half
    # Flat points have no hull, and two of them are the corners of a cell.
    if len(points) < 4 or np.linalg.svd(points - points.mean(0), compute_uv=False)[-1] < FLAT_M:
        return straight
    T_box_points, extents = trimesh.bounds.oriented_bounds(points)
    turned = np.maximum(np.asarray(extents) / 2, LEAST_HALF_M)
    return (np.linalg.inv(T_box_points), turned) if turned.prod() < SMALLER * half.prod() else straight


def depth_in_hull(points: Array, samples: Array) -> Array:
    """How far samples (S, 3) lie below the convex hull of points (N, 3), [m]; zeros where these are flat."""
    try:
        hull = ConvexHull(points)
    except QhullError:
        return np.zeros(len(samples))
    return -(samples @ hull.equations[:, :3].T + hull.equations[:, 3]).max(1)
