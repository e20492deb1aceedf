"""Distance between the rendered contour of the robot and the contour in an image.

A short line of pixels crosses each point of the rendered contour. The colors inside and outside of the silhouette determine for
each pixel of the line on which side of the true outline it is; the gradient determines the exact position. Source: the sparse
region-based trackers of Stoiber et al., "SRT3D", 2022, here with many views at once and a similarity instead of a rigid motion.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter

from aomgen.core.camera import Camera
from aomgen.core.least_squares import Kernel
from aomgen.core.transforms import apply
from aomgen.core.values import Array

# Bins of a color histogram for each channel: 256 gray levels shifted right by 4 bits.
BINS = 16
# Gray-level step, 0..1, of an edge with full weight.
CLEAR_EDGE = 0.05
# Variance of the border between two colors in a perfectly sharp image, [px^2].
BORDER_VARIANCE = 0.5
# Errors of neighboring contour points are correlated: this number of points counts as one.
CORRELATED_POINTS = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignmentImage:
    """One image (H, W, 3) to align with, of a scan or the first of a fixed camera, by name."""

    name: str
    camera_recon: Camera
    image_srgb: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class Contour:
    """Points of a rendered contour.

    Attributes:
        pixels: (C, 2), on the outline, [px].
        normals: (C, 2), unit, out of the silhouette.
        points: (C, 3) on the robot, in the frame of the rendering camera.
    """

    pixels: Array
    normals: Array
    points: Array

    def move(self, points: Array, camera: Camera) -> "Contour":
        """Move the points of the contour after a small motion of robot or camera; the normals are kept."""
        return replace(self, points=points, pixels=camera.project(points)[0] + 0.5 * self.normals)


def outline(camera: Camera, mask: NDArray[np.bool_], depth: NDArray[np.float32], limit: int) -> Contour:
    """Trace the outline of a silhouette, thinned to `limit` points, without the image border."""
    window = _window(mask, 10)
    low_v, low_u = window[0].start, window[1].start
    small = mask[window]
    smooth = gaussian_filter(small.astype(np.float32), 2.0)
    around = np.pad(small, 1)
    inner = small & ~(around[2:, 1:-1] & around[:-2, 1:-1] & around[1:-1, 2:] & around[1:-1, :-2])
    v, u = np.nonzero(inner)
    height, width = mask.shape
    from_top, from_left = v + low_v, u + low_u
    within = (from_top >= 3) & (from_top < height - 3) & (from_left >= 3) & (from_left < width - 3)
    v, u = v[within], u[within]
    if len(v) > limit:
        keep = np.linspace(0, len(v) - 1, limit).astype(int)
        v, u = v[keep], u[keep]
    normals = -np.stack([np.gradient(smooth, axis=1)[v, u], np.gradient(smooth, axis=0)[v, u]], 1)
    lengths = np.linalg.norm(normals, axis=1)
    good = lengths > 0.02
    v, u, normals = v[good] + low_v, u[good] + low_u, normals[good] / lengths[good, None]
    centers = np.stack([u + 0.5, v + 0.5], 1)
    z = depth[v, u].astype(np.float64)
    points_cam = np.stack(
        [(centers[:, 0] - camera.cx) / camera.fx * z, (centers[:, 1] - camera.cy) / camera.fy * z, z], 1
    )
    return Contour(
        pixels=centers + 0.5 * normals,
        normals=normals,
        points=apply(camera.T_world_cam, points_cam),
    )


def _window(mask: NDArray[np.bool_], margin: int) -> tuple[slice, slice]:
    """Return the rows and columns of a non-empty mask, with a margin."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return (
        slice(max(0, int(rows[0]) - margin), int(rows[-1]) + 1 + margin),
        slice(max(0, int(columns[0]) - margin), int(columns[-1]) + 1 + margin),
    )


def color_ratio(image: NDArray[np.uint8], mask: NDArray[np.bool_], reach: int) -> NDArray[np.float32]:
    """Log ratio (H, W) of a pixel's color inside the silhouette to just outside; 0 farther away."""
    window = _window(mask, 2 * reach)
    inner = mask[window]
    bins = (image[window] >> 4).astype(np.int32) @ np.array([BINS * BINS, BINS, 1], np.int32)
    near = maximum_filter(inner.view(np.uint8), 2 * max(2, round(0.7 * reach)) + 1) > 0
    inside = _histogram(bins[inner])
    outside = _histogram(bins[near & ~inner])
    ratio = np.zeros(mask.shape, np.float32)
    ratio[window] = np.log(inside / outside).clip(-3, 3).astype(np.float32)[bins]
    return ratio


def _histogram(bins: NDArray[np.int32]) -> Array:
    counts = np.bincount(bins, minlength=BINS**3).reshape(BINS, BINS, BINS).astype(np.float64)
    smooth = gaussian_filter(counts, 0.7)
    return (smooth.ravel() + 1e-3 * max(1.0, counts.sum()) / BINS) / max(1.0, counts.sum())


def region_shifts(contour: Contour, ratio: NDArray[np.float32], reach: int) -> tuple[Array, Array]:
    """Estimate signed shifts (C,) outwards and their standard deviations (C,), [px], from the colors on both sides."""
    offsets = np.arange(-reach, reach + 1)
    lines = _along(ratio, contour, offsets)
    # Score of an outline between samples k-1 and k: the samples before are inside, those after it outside.
    before = np.concatenate([np.zeros((len(lines), 1)), np.cumsum(lines, 1)], 1)
    scores = 2 * before - before[:, -1:]
    scores = (scores - scores.max(1, keepdims=True)) * 0.5
    weights = np.exp(scores)
    weights /= weights.sum(1, keepdims=True)
    steps = np.arange(-reach, reach + 2) - 0.5
    means = weights @ steps
    return means, np.sqrt(weights @ steps**2 - means**2 + BORDER_VARIANCE)


def border_kernel(reach: int) -> Kernel:
    """Return the robust kernel of shifts to color borders: a shift of half the search reach has half the weight."""
    return Kernel(scale=0.5 * reach, power=1.0)


def edge_shifts(contour: Contour, gray: NDArray[np.float32], reach: int) -> tuple[Array, Array]:
    """Measure signed shifts (C,) to the strongest image edge across the outline, [px], and its strength (C,).

    The strength is the step across the edge, in gray levels 0..1. A parabola gives the position within a pixel.
    """
    offsets = np.arange(-reach - 2, reach + 3)
    lines = _along(gray, contour, offsets)
    steps = np.abs((lines[:, 2:] - lines[:, :-2]) / 2)[:, 1:-1]
    # A slight preference for near edges breaks ties between parallel ones.
    preferred = steps * np.exp(-0.5 * (offsets[2:-2] / max(reach, 1)) ** 2)
    best = np.argmax(preferred, 1).clip(1, steps.shape[1] - 2)
    rows = np.arange(len(best))
    left, middle, right = steps[rows, best - 1], steps[rows, best], steps[rows, best + 1]
    bend = left - 2 * middle + right
    fraction = np.where(np.abs(bend) > 1e-6, 0.5 * (left - right) / np.where(bend == 0, 1, bend), 0.0)
    return (offsets[2:-2][best] + fraction.clip(-0.5, 0.5)).astype(np.float64), middle.astype(np.float64)


def edge_sds(strength: Array) -> Array:
    """Compute standard deviations (C,) of shifts to edges of some strength, [px], relative to that of a strong edge."""
    return 1 / np.sqrt(np.clip(strength / CLEAR_EDGE, 1e-9, 1.0))


def _along(field: NDArray[np.float32], contour: Contour, offsets: NDArray[np.int64]) -> Array:
    places = contour.pixels[:, None] + offsets[None, :, None] * contour.normals[:, None]
    rows_columns = [places[..., 1] - 0.5, places[..., 0] - 0.5]
    return map_coordinates(field, rows_columns, np.float64, order=1, mode="nearest")


def shift_gradient(camera: Camera, contour: Contour) -> Array:
    """Change (C, 3) of the outline along its normals for a motion of its points, [px/m]."""
    return np.einsum("cu,cud->cd", contour.normals, camera.projection_slopes(contour.points))


def shift_jacobian(camera: Camera, contour: Contour, pivot: Array) -> Array:
    """Change (C, 7) of the outline along its normals for a motion of the robot about `pivot`.

    Columns: rotation vector [rad], translation [m], log scale; the camera stays.
    """
    gradient = shift_gradient(camera, contour)
    arm = contour.points - pivot
    columns = [np.cross(arm, gradient), gradient, np.einsum("cd,cd->c", gradient, arm)[:, None]]
    return np.concatenate(columns, 1).astype(np.float64)
