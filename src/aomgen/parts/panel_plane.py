"""The front plane of a prompted part, and a frame on it."""

import numpy as np

from aomgen.core.boxes import find_upright_axes
from aomgen.core.transforms import transform
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError

STAGE = "parts"
# Fronts this close to level or upright are so: objects stand on something, and planes are found to a degree
# or two. Lids that stand ajar lean more.
SNAP_DEG = 4.0
# Reconstructed surfaces scatter about their plane by this share of the part's diagonal.
SCATTER_SHARE = 0.015
# RANSAC samples: with a third of inliers a good one is missed with a probability far below 1e-9.
TRIALS = 1000
# Surface pixels below which the normal of a plane is noise.
MIN_POINTS = 50


def panel_frame(
    points_of_views: list[Array], centers_world: Array, rng: np.random.Generator
) -> tuple[Array, float]:
    """Frame on the largest plane among the points that the part's boxes show.

    Args:
        points_of_views: Surface points (N, 3) inside the box, one array a view, world frame.
        centers_world: Camera centres (V, 3); the front faces them.
        rng: For the plane search.

    Returns:
        T_world_panel (4, 4): x along the part, y up (across, when the part is level), z outward;
        and the diagonal of what the boxes show, [m].

    Raises:
        ReconstructionError: The boxes show almost no surface.
    """
    few = min(len(points) for points in points_of_views)
    if not few >= MIN_POINTS:
        raise ReconstructionError(
            STAGE,
            f"a box of the moving part shows {few} pixels of surface, want {MIN_POINTS}",
            "draw it on an image that shows the part",
        )
    count = min(few, 3000)
    points = np.concatenate([p[rng.choice(len(p), count, replace=False)] for p in points_of_views])
    low, high = np.quantile(points, [0.1, 0.9], axis=0)
    size = float(np.linalg.norm(high - low))
    normal, origin, near = _plane(points, SCATTER_SHARE * size, rng)
    if (centers_world.mean(0) - origin) @ normal < 0:
        normal = -normal
    up = np.array([0.0, 0.0, 1.0])
    if abs(normal[2]) < np.sin(np.radians(SNAP_DEG)):
        normal = normal * [1, 1, 0] / np.linalg.norm(normal[:2])
    elif abs(normal[2]) > np.cos(np.radians(SNAP_DEG)):
        normal = np.array([0.0, 0.0, np.sign(normal[2])])
        up = np.append(find_upright_axes(near)[:2, 0], 0.0)
    up = up - (up @ normal) * normal
    up /= np.linalg.norm(up)
    return transform(np.stack([np.cross(up, normal), up, normal], 1), origin), size


def _plane(points: Array, tolerance: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Unit normal, a point, and the points near the plane that most of them (N, 3) lie on."""
    corners = points[rng.integers(len(points), size=(TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    offsets = np.sum(normals * corners[:, 0], axis=1)
    counts = (np.abs(points @ normals.T - offsets) < tolerance).sum(0)
    best = int(np.argmax(counts))
    normal, origin = normals[best], corners[best, 0]
    near = points
    for _ in range(3):
        close = np.abs((points - origin) @ normal) < tolerance
        if close.sum() < 3:
            break
        near = points[close]
        origin = near.mean(0)
        normal = np.linalg.svd(near - origin, full_matrices=False)[2][2]
    return normal, origin, near
