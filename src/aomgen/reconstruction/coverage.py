"""Where a scan looked: how many views saw each place, and from how different directions.

A place is anything with a position: a Gaussian, a point on the side of a box. A view sees it when
it lies inside the image, faces the camera, and the surface drawn there is not in front of it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array, freeze
from aomgen.errors import BackendError
from aomgen.splatting.rasterizer import render

# Views are looked at in this width: a pixel is then as wide as depth is uncertain, roughly.
WIDTH_PX = 320
# Parallax that stereo works with. Depth is uncertain by a pixel's width over it; what lies less
# than that behind a drawn surface is on it.
PARALLAX_DEG = 8.0
# Views that a depth needs: one, and two that confirm it.
MIN_VIEWS = 3
# A side under a flatter angle than this shows nothing.
MIN_COSINE = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewDepth:
    """What a view sees, as depth.

    Attributes:
        camera: At the map's size, any frame.
        depth: (H, W) float32, of the drawn surface; infinite where nothing stops the view.
    """

    camera: Camera
    depth: NDArray[np.float32]

    def behind(self, points: Array) -> Array:
        """How far points (N, 3) lie behind the drawn surface, in uncertainties of depth.

        Negative in front of it, about -1..1 on it, NaN where the view does not look.
        """
        pixels, depths = self.camera.project(points)
        with np.errstate(invalid="ignore"):
            columns, rows = np.floor(np.clip(pixels, -1, 1e6)).astype(np.int64).T
        inside = (depths > 0) & (columns >= 0) & (rows >= 0)
        inside &= (columns < self.camera.width) & (rows < self.camera.height)
        drawn = self.depth[rows[inside], columns[inside]]
        result = np.full(len(points), np.nan)
        unit = np.tan(np.radians(PARALLAX_DEG)) * self.camera.fx * WIDTH_PX / self.camera.width
        result[inside] = (depths[inside] - drawn) / (depths[inside] / unit)
        return result


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """How N places were looked at.

    Attributes:
        views: Number of views that see each, (N,).
        spread_deg: Width of the cone around the mean direction that holds all directions from which each is
            seen, (N,), [deg]; 0 with less than two views.
    """

    views: NDArray[np.uint16]
    spread_deg: NDArray[np.float32]

    def __post_init__(self) -> None:
        freeze(self, "views", self.views, (None,), np.uint16)
        freeze(self, "spread_deg", self.spread_deg, (len(self.views),), np.float32)

    @property
    def enough(self) -> NDArray[np.bool_]:
        """Places (N,) whose depth the scan decides."""
        return (self.views >= MIN_VIEWS) & (self.spread_deg >= PARALLAX_DEG)


def view_depths(gaussians: Gaussians, cameras: list[Camera], width: int = WIDTH_PX) -> list[ViewDepth]:
    """Depth of a scene's surfaces in each view, at most `width` pixels wide.

    Raises:
        BackendError: The engine is missing, or refuses the scene or a camera.
    """
    result = []
    for camera in cameras:
        share = min(1.0, width / camera.width)
        small = camera.resized(round(camera.width * share), max(1, round(camera.height * share)))
        drawn = render(gaussians, small, with_ids=True).median_depth
        if drawn is None:
            raise BackendError("rasterizer", "drew no depth", "rebuild the engine")
        result.append(ViewDepth(camera=small, depth=np.where(drawn > 0, drawn, np.inf).astype(np.float32)))
    return result


def coverage_of(points: Array, views: list[ViewDepth], normals: Array | None = None) -> Coverage:
    """How points (N, 3) were looked at.

    Args:
        points: In the frame of the views' cameras.
        views: What each view sees.
        normals: Unit outward directions (N, 3); without them every side counts.
    """
    seen = np.zeros((len(views), len(points)), bool)
    directions = np.zeros((len(views), len(points), 3), np.float32)
    for row, view in enumerate(views):
        rays = view.camera.center - points
        directions[row] = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        # NaN, where the view does not look, compares as False.
        seen[row] = view.behind(points) <= 1
        if normals is not None:
            seen[row] &= (directions[row] * normals).sum(1) > MIN_COSINE
    middle = np.einsum("vn,vnk->nk", seen.astype(np.float32), directions)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    cosines = np.where(seen, np.einsum("vnk,nk->vn", directions, middle), 1.0).min(0, initial=1.0)
    return Coverage(views=seen.sum(0), spread_deg=2 * np.degrees(np.arccos(np.clip(cosines, -1, 1))))
