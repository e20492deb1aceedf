"""Choose scan images for prompts: those that show a body completely, without the robot before it, from different sides."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from aomgen.core.values import Array
from aomgen.io.images import fill_hull
from aomgen.parts.scan_views import ScanView
from aomgen.prompting.moved_panel import Front
from aomgen.segmentation.interface import Mask

# Smallest cosine between a view from the front and the front (60 degrees). Larger cosines than the second one show more of
# the moving part than of the body.
MIN_FRONT_COSINE, MAX_SIDE_COSINE = 0.5, 0.6
# Largest share of the front, and of a body, that the robot hides.
MAX_FRONT_HIDDEN, MAX_BODY_HIDDEN = 0.1, 0.02
# Smallest margin to the image border around the front, and around a body, as a share of the image's width.
FRONT_BORDER, BODY_BORDER = 1 / 50, 1 / 30
# Number of views that determine the depth of a body, and the angle between them, [deg].
SIDE_VIEWS, APART_DEG = 3, 30.0
# Views at a smaller angle to each other are redundant, [deg].
LEAST_APART_DEG: Final = 3.0


def choose_front_views(views: Sequence[ScanView], front: Front) -> list[ScanView]:
    """Choose the views that show a front largest, from the front and without occlusion; largest first."""
    shown: list[tuple[int, ScanView]] = []
    for view in views:
        if _compute_cosine(view, front.center, front) < MIN_FRONT_COSINE:
            continue
        region = _find_region(view, front.corners_world, FRONT_BORDER, MAX_FRONT_HIDDEN)
        if region is not None:
            shown.append((int(region.sum()), view))
    return [view for _, view in sorted(shown, key=lambda item: -item[0])]


def choose_side_views(views: Sequence[ScanView], front: Front, corners: Array) -> list[ScanView]:
    """Choose views from different sides, not from the front, that show a body (8, 3) completely; best first."""
    shown: list[tuple[float, ScanView]] = []
    for view in views:
        cosine = _compute_cosine(view, corners.mean(0), front)
        if cosine > MAX_SIDE_COSINE:
            continue
        region = _find_region(view, corners, BODY_BORDER, MAX_BODY_HIDDEN)
        if region is not None:
            # The smaller the angle between view and front, the less of the body is visible.
            shown.append((float(region.sum()) * (1.0 - cosine), view))
    ordered = [view for _, view in sorted(shown, key=lambda item: -item[0])]
    return choose_apart(ordered, corners.mean(0), SIDE_VIEWS, APART_DEG)


def _compute_cosine(view: ScanView, target: Array, front: Front) -> float:
    """Compute the cosine of the angle between a front and the direction from a target (3,) to a view's camera."""
    away = view.camera.center - target
    return float(-(away / np.linalg.norm(away)) @ front.axes[2])


def _find_region(view: ScanView, corners: Array, border: float, max_hidden: float) -> Mask | None:
    """Find the image region (H, W) of the hull of corners (N, 3); None if it is not shown completely.

    Args:
        border: Smallest margin to the image border, as a share of the image's width.
        max_hidden: Largest share of the region that the robot hides.
    """
    camera = view.camera
    pixels, depths = camera.project(corners)
    margin = border * camera.width
    inside = (pixels >= margin) & (pixels <= np.array([camera.width, camera.height]) - margin)
    if not (np.all(depths > 0) and np.all(inside)):
        return None
    region = fill_hull(pixels, camera.width, camera.height)
    return region if (region & view.robot).sum() <= max_hidden * region.sum() else None


def choose_apart(views: Sequence[ScanView], target: Array, count: int, apart_deg: float) -> list[ScanView]:
    """Choose the first views, at most `count`, whose directions to a target (3,) differ by an angle, [deg].

    The angle is halved until there are enough views; their order is kept.
    """
    while True:
        chosen = _keep_apart(views, target, count, apart_deg)
        if len(chosen) == min(count, len(views)) or apart_deg < LEAST_APART_DEG:
            return chosen
        apart_deg /= 2


def _keep_apart(views: Sequence[ScanView], target: Array, count: int, apart_deg: float) -> list[ScanView]:
    chosen: list[ScanView] = []
    directions: list[Array] = []
    for view in views:
        away = view.camera.center - target
        away = away / np.linalg.norm(away)
        if len(chosen) < count and all(away @ other <= np.cos(np.radians(apart_deg)) for other in directions):
            chosen.append(view)
            directions.append(away)
    return chosen
