"""Estimate the body of an object behind its moving front as a 3D box; segments of scan images determine its depth."""

from collections.abc import Sequence
from itertools import product
from typing import Final

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from aomgen.core.boxes import fit_plane
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.io.images import fill_hull
from aomgen.parts.panel_terms import iou
from aomgen.parts.scan_views import ScanView
from aomgen.prompting.moved_panel import Front
from aomgen.prompting.video_regions import REMEDY
from aomgen.prompting.view_choice import choose_side_views
from aomgen.segmentation.interface import Mask, Segmenter

# Sparse points within this distance of the front may belong to the object, [m].
NEIGHBORHOOD_M: Final = 1.0
# Largest distance between neighboring points of an object, [m]; they are on the edges of textureless faces.
LINK_M: Final = 0.06
# Error of sparse points, and height above the support above which points belong to the object, [m].
SUPPORT_M, ABOVE_M = 0.01, 0.02
# Largest tilt of the support, [deg]; the tilt of a robot's base is about a degree.
MAX_TILT_DEG: Final = 5.0
# Number of sampled triples of points; at least a tenth of the points are on the support.
TRIALS: Final = 500
# Smallest number of points on a support.
MIN_SUPPORT: Final = 30
# Share of outermost points that are treated as outliers.
STRAYS: Final = 0.02
# Tested depths of a body, [m], in steps of about 10 %.
DEPTHS_M: Final = np.geomspace(0.08, 0.8, 25)


def find_object_points(points_world: Array, front: Front, rng: np.random.Generator) -> tuple[Array, float]:
    """Find the sparse points (M, 3) of the object, and the height of its support, [m].

    Args:
        points_world: Sparse points (P, 3) without those of the robot.

    Raises:
        ReconstructionError: No surface below the moving part has enough points.
    """
    near = points_world[np.linalg.norm(points_world - front.center, axis=1) < NEIGHBORHOOD_M]
    below = near[near[:, 2] < front.corners_world[:, 2].min() + ABOVE_M]
    up = np.array([0.0, 0.0, 1.0])
    plane = None
    if len(below) >= MIN_SUPPORT:
        plane = fit_plane(below, SUPPORT_M, rng, TRIALS, axis=up, max_tilt_deg=MAX_TILT_DEG)
    if plane is None:
        raise ReconstructionError(
            "proposals",
            f"{len(below)} points of the scan are below the moving part, at least {MIN_SUPPORT} on a level support are needed",
            REMEDY,
        )
    normal, anchor = plane
    normal = normal * np.sign(normal[2])
    above = near[(near - anchor) @ normal > ABOVE_M]
    steps = np.linspace(0, 1, 1 + int(np.ceil(NEIGHBORHOOD_M / LINK_M)))
    low, along, up_side = (
        front.corners_world[0],
        *(front.corners_world[k] - front.corners_world[0] for k in (1, 3)),
    )
    seeds = (low + steps[:, None, None] * along + steps[None, :, None] * up_side).reshape(-1, 3)
    together = np.concatenate([seeds, above])
    pairs = cKDTree(together).query_pairs(LINK_M, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(together),) * 2)
    _, groups = connected_components(links, directed=False)
    own = np.isin(groups, np.unique(groups[: len(seeds)]))
    middle = front.center
    height = float(anchor[2] - (normal[:2] @ (middle[:2] - anchor[:2])) / normal[2])
    return together[own], height


def make_body(points_world: Array, support_z: float, front: Front, depth_m: float) -> Array:
    """Compute the corners (8, 3) of a body of a given depth behind a front, as wide and high as its points (M, 3)."""
    local = (points_world - front.center) @ front.axes.T
    sides = (front.corners_world - front.center) @ front.axes.T
    low, high = np.quantile(local, [STRAYS, 1 - STRAYS], axis=0)
    low, high = np.minimum(low, sides.min(0)), np.maximum(high, sides.max(0))
    up_z = front.axes[1, 2]
    if up_z > 0.5:  # an upright front: the body begins on the support
        low[1] = min(low[1], (support_z - front.center[2]) / up_z)
    corners = np.array(list(product((low[0], high[0]), (low[1], high[1]), (0.0, depth_m))))
    return front.center + corners @ front.axes


def find_body(
    points_world: Array,
    support_z: float,
    front: Front,
    views: Sequence[ScanView],
    segmenter: Segmenter,
) -> list[tuple[ScanView, Mask, float]]:
    """Segment the body in views that show it, and choose the depth whose outline agrees best with the segments.

    Args:
        points_world, support_z: See `find_object_points`.

    Returns:
        Views from different sides, each with the mask (H, W) of the body without the visible moving part and the IoU of
        segment and projected box, 0..1; largest IoU first.

    Raises:
        ReconstructionError: No view shows the whole body.
    """
    typical = float(np.median(DEPTHS_M))
    chosen = choose_side_views(views, front, make_body(points_world, support_z, front, typical))
    if not chosen:
        raise ReconstructionError(
            "proposals",
            "no scan image shows the whole object from a side without the robot before it",
            REMEDY,
        )
    prepared = [segmenter.prepare(view.name, view.image_srgb) for view in chosen]
    best: list[tuple[float, Mask]] = []
    for depth in DEPTHS_M:
        corners = make_body(points_world, support_z, front, float(depth))
        found: list[tuple[float, Mask]] = []
        for view, image in zip(chosen, prepared, strict=True):
            pixels, _ = view.camera.project(corners)
            outline = fill_hull(pixels, view.camera.width, view.camera.height)
            box = np.concatenate([pixels.min(0), pixels.max(0)])
            mask = image.mask(
                "object", np.clip(box, 0, 2 * [view.camera.width, view.camera.height]), np.zeros((0, 3))
            )
            found.append((iou(mask, outline), mask))
        if not best or np.mean([share for share, _ in found]) > np.mean([share for share, _ in best]):
            best = found
    result = []
    for view, (agreement, mask) in zip(chosen, best, strict=True):
        covered = fill_hull(view.camera.project(front.handle_space)[0], view.camera.width, view.camera.height)
        result.append((view, mask & ~covered & ~view.robot, agreement))
    return sorted(result, key=lambda item: -item[2])
