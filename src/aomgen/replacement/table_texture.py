"""Texture of the table without its object, composed from all photographs and completed in unobserved regions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import (
    binary_dilation,
    binary_erosion,
    distance_transform_edt,
    gaussian_filter,
    map_coordinates,
)
from scipy.sparse.linalg import LaplacianNd, spsolve

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.robust import compute_masked_median
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.splatting.rasterizer import render

# Surfaces within this distance of the plane belong to it, [m]; trained surfaces have this thickness.
ON_PLANE: Final = 0.012
# A pixel shows only the surface if objects in front of it contribute less than this share.
BEFORE: Final = 0.05
# Sine of the angle between view and surface below which the texture is blurred.
GRAZING: Final = 0.2
# Least number of views of a cell, because a single photograph may show a reflection or a moving obstacle.
MIN_VIEWS: Final = 2
# Cells are rejected if their colors differ between views by this multiple of the usual difference and by more than
# noise, because they show a mirror image or an outline. Strips between such cells that are narrower than twice OPENED
# cells are rejected as well.
UNSURE, NOISE, OPENED = 3.0, 0.02, 3
# Patch side, [px].
PATCH: Final = 25
# Number of random patches that are compared at each position, before the neighborhood of the best one is searched.
CANDIDATES: Final = 600
# Scale that separates color (coarser) from texture (finer), [px].
SMOOTHING: Final = 15.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Photograph:
    """A photograph (H, W, 3) of the scan and its camera, world frame."""

    camera: Camera
    image_srgb: NDArray[np.uint8]


def photograph_surface(
    world: Gaussians, scene: NDArray[np.bool_], views: Sequence[Photograph], T_world_plane: Array, xy: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Compute the colors of cells of a plane from all views in which they are visible.

    Args:
        world: Gaussians of the scanned scene, world frame.
        scene: Mask (N,) of the Gaussians that belong neither to the robot nor to the object.
        views: Photographs of the scene.
        T_world_plane: Pose of the plane, on which z is 0.
        xy: Centers of the cells (H, W, 2), plane frame.

    Returns:
        Median colors over the views (H, W, 3), sRGB, 0..1, 0 where the surface is not visible; and a mask (H, W) of the
        cells that are visible in two or more views with equal colors.
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
    # Morphological opening in which the image continues beyond its border.
    seen &= binary_dilation(binary_erosion(seen, iterations=OPENED, border_value=1), iterations=OPENED)
    return np.where(seen[..., None], median, 0.0).astype(np.float64), seen


def inpaint(image: Array, known: NDArray[np.bool_], rng: np.random.Generator) -> Array:
    """Complete the unknown pixels (H, W) of an image (H, W, 3); an image without known pixels becomes gray.

    `rng` selects candidate patches.
    """
    if not known.any():
        return np.full(image.shape, 0.5)
    smooth = continue_smoothly(image, known)
    detail = np.where(known[..., None], image - smooth, 0.0)
    texture = _quilt(detail, known, rng)
    return np.where(known[..., None], image, smooth + texture)


def continue_smoothly(image: Array, known: NDArray[np.bool_]) -> Array:
    """Return the colors (H, W, C) of an image without its texture, continued smoothly to unknown pixels."""
    return _membrane(_blur(image, known), known)


def _blur(image: Array, known: NDArray[np.bool_]) -> Array:
    """Average known colors over known neighbors."""
    weight = gaussian_filter(known.astype(float), SMOOTHING)
    masked = np.where(known[..., None], image, 0.0)
    total = gaussian_filter(masked, (SMOOTHING, SMOOTHING, 0))
    return total / np.maximum(weight, 1e-6)[..., None]


def _membrane(image: Array, known: NDArray[np.bool_]) -> Array:
    """Continue an image into unknown pixels by solving Laplace's equation."""
    if known.all():
        return image
    flat = known.ravel()
    laplacian = LaplacianNd(known.shape, boundary_conditions="neumann").tosparse().astype(np.float64)
    rows = laplacian.tocsr()[~flat]
    colors = np.array(image, np.float64).reshape(-1, image.shape[-1])
    filled = spsolve(rows[:, ~flat].tocsc(), -rows[:, flat] @ colors[flat])
    colors[~flat] = np.asarray(filled).reshape(-1, image.shape[-1])
    return colors.reshape(image.shape)


def _quilt(detail: Array, known: NDArray[np.bool_], rng: np.random.Generator) -> Array:
    """Synthesize texture by copying patches of the known part, from the border inwards.

    Source: Efros & Freeman 2001, with soft seams.
    """
    half = PATCH // 2
    result, sure = np.array(detail), known.astype(float)
    whole = np.asarray(sliding_window_view(known, (PATCH, PATCH)).all((2, 3)))
    sources = np.argwhere(whole)
    if not len(sources):
        return result
    windows = np.asarray(sliding_window_view(detail, (PATCH, PATCH, 3)))[:, :, 0]
    inner = np.asarray(distance_transform_edt(~known))
    # Neighboring patches overlap by more than half.
    grid = np.argwhere(~known)
    grid = grid[(grid % half == 0).all(1)]
    grid = grid[np.argsort(inner[tuple(grid.T)], kind="stable")]
    ramp = 1 - np.abs(np.arange(PATCH) - half) / (half + 1)
    feather = np.minimum.outer(ramp, ramp)
    height, width = known.shape
    for row, column in grid:
        r = int(np.clip(row - half, 0, height - PATCH))
        c = int(np.clip(column - half, 0, width - PATCH))
        box = (slice(r, r + PATCH), slice(c, c + PATCH))
        weight = sure[box]
        tries = sources[rng.integers(0, len(sources), CANDIDATES)]
        best = _closest(windows, tries, result[box], weight)
        around = best + np.argwhere(np.ones((7, 7), bool)) - 3
        inside = ((around >= 0) & (around < whole.shape)).all(1)
        around = around[inside]
        best = _closest(windows, around[whole[tuple(around.T)]], result[box], weight)
        patch = windows[best[0], best[1]]
        # Steep blending weights, because averaging many patches would blur the texture.
        share = np.where(known[box], 0.0, feather**4 / (feather**4 + weight**4))[..., None]
        result[box] = (1 - share) * result[box] + share * patch
        sure[box] = np.where(known[box], 1.0, np.maximum(weight, feather))
    return result


def _closest(windows: NDArray, places: NDArray[np.int64], target: Array, weight: Array) -> NDArray[np.int64]:
    """Find the position (2,) whose window (P, P, 3) has the smallest difference from the target (P, P, 3)."""
    found = windows[places[:, 0], places[:, 1]]
    difference = (found - target) ** 2
    return places[int(np.argmin(np.einsum("nijk,ij->n", difference, weight)))]
