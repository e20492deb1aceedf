"""Tracking of points from image to image, which measures the motion of a camera's view."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, uniform_filter

from aomgen.core.values import Array

# A gray image at full, half and quarter size, (H, W) each.
Pyramid = tuple[NDArray[np.float32], ...]
# Pyramid levels: tracking succeeds for motions of up to four windows between frames.
LEVELS = 3
# Largest number of Lucas-Kanade steps at a level; the iteration ends earlier if it converges, see `CONVERGED_PX`.
ITERATIONS = 6
# Half side of the tracked window, [px]: 11 x 11, a common size for corners.
HALF_WINDOW = 5
# Cells across and down the image, so that points cover the view.
GRID = (12, 9)
# Least correlation of a tracked patch with the first one.
MIN_CORRELATION = 0.75
# Least texture that can be tracked: smaller eigenvalue of the mean squared gradient, [gray^2 / px^2].
MIN_TEXTURE = 4.0
# Step that ends the iteration, [px]: far below the motions that are compared with limits.
CONVERGED_PX = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracks:
    """Points of an image and their positions in a later image.

    Attributes:
        start: (N, 2) pixel x, y in the first image.
        now: (N, 2) in the later image.
        alive: (N,) whether the point is still tracked.
    """

    start: Array
    now: Array
    alive: NDArray[np.bool_]

    @property
    def kept(self) -> float:
        """Share still followed; 1 where there was nothing to follow."""
        return float(self.alive.mean()) if len(self.alive) else 1.0

    @property
    def shift_px(self) -> float:
        """Root mean square displacement of those still followed, [px]."""
        if not self.alive.any():
            return 0.0
        return float(np.sqrt(((self.now - self.start)[self.alive] ** 2).sum(1).mean()))


def pyramid(gray: NDArray[np.uint8]) -> Pyramid:
    """Build the image pyramid of an image (H, W); each level has half the size of the previous one."""
    levels = [gray.astype(np.float32)]
    for _ in range(LEVELS - 1):
        above = levels[-1]
        even = above[: above.shape[0] // 2 * 2, : above.shape[1] // 2 * 2]
        levels.append(even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).mean((1, 3)))
    return tuple(levels)


def new_tracks(image: Pyramid) -> Tracks:
    """Find the point with the most texture in every cell of a grid; cells without texture have none.

    Source: Shi & Tomasi, Good features to track (1994).
    """
    gray = image[0]
    gy, gx = np.gradient(gray)
    size = 2 * HALF_WINDOW + 1
    xx, yy, xy = (uniform_filter(product, size) for product in (gx * gx, gy * gy, gx * gy))
    texture = 0.5 * (xx + yy - np.sqrt((xx - yy) ** 2 + 4 * xy**2))
    border = 2 * HALF_WINDOW
    texture[:border], texture[-border:], texture[:, :border], texture[:, -border:] = 0, 0, 0, 0
    points = []
    for rows in np.array_split(np.arange(gray.shape[0]), GRID[1]):
        for columns in np.array_split(np.arange(gray.shape[1]), GRID[0]):
            cell = texture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            row, column = np.unravel_index(int(np.argmax(cell)), cell.shape)
            if cell[row, column] >= MIN_TEXTURE:
                points.append((columns[0] + column, rows[0] + row))
    start = np.array(points, np.float64).reshape(-1, 2)
    return Tracks(start=start, now=start.copy(), alive=np.ones(len(start), bool))


def follow(tracks: Tracks, first: Pyramid, before: Pyramid, after: Pyramid) -> Tracks:
    """Track the points into the next image.

    Args:
        tracks: Points as they were in `before`.
        first: The image of the starting points; the current patches are compared with it.
        before, after: Two consecutive images.

    Source: Lucas & Kanade (1981) on a pyramid, Bouguet (2001); gain and offset of a patch are
    free in the comparison, so that exposure may change.
    """
    shift = np.zeros_like(tracks.now)
    for level in reversed(range(LEVELS)):
        scale = 0.5**level
        a, b = before[level], after[level]
        # The displacement is zero on the coarsest level.
        shift = _track_level(a, b, tracks.now * scale, 2 * shift)
    now = tracks.now + shift
    inside = ((now >= HALF_WINDOW) & (now <= np.array(after[0].shape[::-1]) - 1 - HALF_WINDOW)).all(1)
    correlation = _correlation(first[0], tracks.start, after[0], now)
    return Tracks(start=tracks.start, now=now, alive=tracks.alive & inside & (correlation >= MIN_CORRELATION))


def _track_level(
    before: NDArray[np.float32], after: NDArray[np.float32], points: Array, shift: Array
) -> Array:
    patches = _patches(before, points)
    gy, gx = (_patches(slope, points) for slope in np.gradient(before))
    xx, yy, xy = (gx * gx).sum(1), (gy * gy).sum(1), (gx * gy).sum(1)
    determinant = np.maximum(xx * yy - xy * xy, 1e-3)
    for _ in range(ITERATIONS):
        error = patches - _patches(after, points + shift)
        bx, by = (gx * error).sum(1), (gy * error).sum(1)
        step = np.stack([yy * bx - xy * by, xx * by - xy * bx], 1) / determinant[:, None]
        shift = shift + np.clip(step, -HALF_WINDOW, HALF_WINDOW)
        if np.abs(step).max(initial=0.0) < CONVERGED_PX:
            break
    return shift


def _correlation(
    image_a: NDArray[np.float32], points_a: Array, image_b: NDArray[np.float32], points_b: Array
) -> Array:
    """Compute the normalized correlation of patches: 1 if they are equal up to gain and offset, 0 if unrelated."""
    a, b = _patches(image_a, points_a), _patches(image_b, points_b)
    a, b = a - a.mean(1, keepdims=True), b - b.mean(1, keepdims=True)
    return (a * b).sum(1) / np.sqrt(np.maximum((a * a).sum(1) * (b * b).sum(1), 1e-6))


def _patches(image: NDArray[np.float32], points: Array) -> Array:
    """Interpolate windows (N, P) around points bilinearly; outside the image the border is repeated."""
    offsets = np.arange(-HALF_WINDOW, HALF_WINDOW + 1)
    x = points[:, 0, None, None] + offsets[None, None, :]
    y = points[:, 1, None, None] + offsets[None, :, None]
    x, y = np.broadcast_arrays(x, y)
    values = map_coordinates(image, [y.ravel(), x.ravel()], order=1, mode="nearest", prefilter=False)
    return np.asarray(values, np.float64).reshape(len(points), -1)
