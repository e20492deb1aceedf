"""Depth of surfaces in views, and Gaussians in the free space before them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array
from aomgen.splatting.rasterizer import Rendering, render

# Views are looked at in this width: a pixel is then as wide as depth is uncertain, roughly.
WIDTH_PX = 320
# Parallax that stereo works with. Depth is uncertain by a pixel's width over it; what lies less
# than that behind a drawn surface is on it.
PARALLAX_DEG = 8.0
# Views that must look through a Gaussian, and how many times as many as have it on their surface.
MIN_BEFORE, BEFORE_TO_ON = 2, 3


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewDepth:
    """Depth of a view.

    Attributes:
        camera: At the map's size, any frame.
        depth: (H, W) float32, of the nearest surface; infinite where nothing stops the view, NaN
            where nothing is known.
    """

    camera: Camera
    depth: NDArray[np.float32]

    def behind(self, points: Array) -> Array:
        """Distance of points (N, 3) behind the surface, in uncertainties of depth.

        Negative before it, about -1..1 on it, NaN where the view does not look or know.
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


def view_depths(gaussians: Gaussians, cameras: list[Camera], width: int = WIDTH_PX) -> list[ViewDepth]:
    """Depth of a scene's surfaces in each view, at most `width` pixels wide."""
    result = []
    for camera in cameras:
        small = camera.narrow(width)
        drawn = np.asarray(render(gaussians, small, with_ids=True).median_depth)
        result.append(ViewDepth(camera=small, depth=np.where(drawn > 0, drawn, np.inf).astype(np.float32)))
    return result


def compute_surface_points(gaussians: Gaussians, camera: Camera) -> Array:
    """World points (H, W, 3) of the surface at each pixel, NaN where less than half of the light is stopped.

    The median depth: the mean one is no surface where a few Gaussians shine past an edge from far behind.
    """
    return compute_rendered_points(render(gaussians, camera, with_ids=True), camera)


def compute_rendered_points(drawn: Rendering, camera: Camera) -> Array:
    """As `compute_surface_points`, for an image that was rendered with ids."""
    depth = np.asarray(drawn.median_depth, np.float64)
    return camera.center + camera.directions() * np.where(depth > 0, depth, np.nan)[..., None]


def in_free_space(points: Array, views: list[ViewDepth]) -> NDArray[np.bool_]:
    """Points (N, 3) that hang where views look through: before the surface in some, on it in hardly any.

    Not checked: what is thinner than a pixel in most views hangs before their surfaces as well.
    """
    before, on = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for view in views:
        behind = view.behind(points)
        before += behind < -1
        on += np.abs(behind) <= 1
    return (before >= MIN_BEFORE) & (before > BEFORE_TO_ON * on)
