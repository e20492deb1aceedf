"""The surface that the object stood on, put together from all photographs that show it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, map_coordinates

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.robust import compute_masked_median
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.splatting.rasterizer import render

# Surfaces within this height of the plane belong to it, [m]: trained surfaces are as thick.
ON_PLANE: Final = 0.012
# A pixel shows the surface alone where objects before it take less than this share.
BEFORE: Final = 0.05
# Sine of the angle below which a view looks along the surface and smears it.
GRAZING: Final = 0.2
# One photograph may show a reflection or a moving obstacle.
MIN_VIEWS: Final = 2
# Cells are rejected where views differ by this multiple of the usual difference, and by more than noise: they show a mirror
# image or an outline. Strips between such cells that are narrower than twice OPENED cells are rejected too.
UNSURE, NOISE, OPENED = 3.0, 0.02, 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Photograph:
    """A photograph (H, W, 3) of the scan and its camera, world frame."""

    camera: Camera
    image_srgb: NDArray[np.uint8]


def photograph_surface(
    world: Gaussians, scene: NDArray[np.bool_], views: Sequence[Photograph], T_world_plane: Array, xy: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Colors of cells of a plane, from every view that sees them.

    Args:
        world: All that stood there, world frame.
        scene: Which Gaussians (N,) are neither robot nor object.
        views: Photographs of it.
        T_world_plane: The plane, z = 0 on it.
        xy: Middles of the cells (H, W, 2), plane frame.

    Returns:
        Median colors over the views (H, W, 3), sRGB, 0..1, 0 where the surface is not seen; and whether two views or
        more see a cell, and agree (H, W).
    """
    points = apply(T_world_plane, np.concatenate([xy, np.zeros_like(xy[..., :1])], -1))
    colors = np.zeros((len(views), *points.shape), np.float32)
    visible = np.zeros((len(views), *points.shape[:2]), bool)
    to_plane = invert(T_world_plane)
    plain, share = world.with_sh_degree(0), scene.astype(np.float32)[:, None]
    for k, view in enumerate(views):
        camera = view.camera
        drawn = render(plain, camera, features=share, with_ids=True)
        depth = np.asarray(drawn.median_depth, np.float64)[..., None]
        heights = apply(to_plane, camera.center + camera.directions() * depth)[..., 2]
        clear = (np.abs(heights) < ON_PLANE) & (np.asarray(drawn.features)[..., 0] > 1 - BEFORE)
        pixels, distance = camera.project(points)
        places = np.nan_to_num(np.moveaxis(pixels[..., ::-1], -1, 0) - 0.5, nan=-1.0)
        ways = camera.center - points
        steep = ways @ T_world_plane[:3, 2] > GRAZING * np.linalg.norm(ways, axis=-1)
        inside = map_coordinates(clear.astype(np.float32), places, order=0) > 0
        visible[k] = inside & steep & (distance > 0)
        for channel in range(3):
            colors[k, ..., channel] = map_coordinates(view.image_srgb[..., channel] / 255, places, order=1)
    median, _ = compute_masked_median(colors, visible)
    spread, _ = compute_masked_median(np.abs(colors - median).mean(-1), visible)
    seen = visible.sum(0) >= MIN_VIEWS
    usual = float(np.median(spread[seen])) if seen.any() else 0.0
    seen &= spread <= max(UNSURE * usual, NOISE)
    # An opening in which the image continues beyond its end.
    seen &= binary_dilation(binary_erosion(seen, iterations=OPENED, border_value=1), iterations=OPENED)
    return np.where(seen[..., None], median, 0.0).astype(np.float64), seen
