"""Depth of the surfaces in views, and detection of Gaussians in the free space in front of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array
from aomgen.splatting.rasterizer import Rendering, render

# Width of depth maps, [px]; at this width, the accuracy of the depth corresponds to about one pixel.
WIDTH_PX = 320
# Typical parallax between views, [deg]. The uncertainty of depth is the width of a pixel divided by its tangent; points
# closer than this to a rendered surface are on it.
PARALLAX_DEG = 8.0
# A Gaussian is in free space if it is before the surface in at least MIN_BEFORE views, and in more than BEFORE_TO_ON times as
# many views as it is on the surface.
MIN_BEFORE, BEFORE_TO_ON = 2, 3


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewDepth:
    """Depth map of a view.

    Attributes:
        camera: Camera of the size of the depth map, in any frame.
        depth: Depth of the nearest surface (H, W) float32; infinite where there is no surface, NaN where it is unknown.
    """

    camera: Camera
    depth: NDArray[np.float32]

    def behind(self, points: Array) -> Array:
        """Compute the depth of points (N, 3) behind the surface (N,), in units of the uncertainty of depth.

        Values are below -1 before the surface and in -1..1 on it. They are NaN outside of the image and where the depth of the
        surface is unknown.
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
    """Render the depth maps of a scene, at most `width` pixels wide."""
    result = []
    for camera in cameras:
        small = camera.narrow(width)
        drawn = np.asarray(render(gaussians, small, with_ids=True).median_depth)
        result.append(ViewDepth(camera=small, depth=np.where(drawn > 0, drawn, np.inf).astype(np.float32)))
    return result


def compute_surface_points(gaussians: Gaussians, camera: Camera) -> Array:
    """Compute the point of the surface at each pixel (H, W, 3), world frame; NaN where the transmittance stays above one half.

    The points have the median depth. At edges, the mean depth lies between the foreground and the background.
    """
    return compute_rendered_points(render(gaussians, camera, with_ids=True), camera)


def compute_rendered_points(drawn: Rendering, camera: Camera) -> Array:
    """Compute `compute_surface_points` from a rendering of the camera with ids."""
    depth = np.asarray(drawn.median_depth, np.float64)
    return camera.center + camera.directions() * np.where(depth > 0, depth, np.nan)[..., None]


def in_free_space(points: Array, views: list[ViewDepth]) -> NDArray[np.bool_]:
    """Return a mask (N,) of the points (N, 3) that are before the surface in several views and on it in few.

    Not checked: an object thinner than a pixel in most views is before their surfaces as well.
    """
    before, on = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for view in views:
        behind = view.behind(points)
        before += behind < -1
        on += np.abs(behind) <= 1
    return (before >= MIN_BEFORE) & (before > BEFORE_TO_ON * on)
