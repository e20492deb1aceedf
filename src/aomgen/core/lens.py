"""Camera intrinsics with lens distortion, and undistortion of points and images."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from aomgen.core.camera import Camera
from aomgen.core.values import Array

# Number of Newton steps from the distorted ray; after the fifth, changes are below 1e-9 for all usable lenses.
NEWTON_STEPS = 12
# Number of points on each edge of the image at which the distortion is evaluated; it is smooth, so that its extremes are
# found with subpixel accuracy.
BORDER_SAMPLES = 64
Resample = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """Intrinsics of one camera: a pinhole with two radial and two tangential distortion coefficients.

    Attributes:
        fx, fy, cx, cy: Intrinsics, [px], pixel centers at +0.5.
        width, height: Image size, [px].
        k1, k2: Radial coefficients, of r^2 and r^4 at depth 1.
        p1, p2: Tangential coefficients.

    Source: D. C. Brown, Close-range camera calibration (1971); coefficients as in OpenCV.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def bends(self) -> bool:
        """True if any distortion coefficient is not 0."""
        return any((self.k1, self.k2, self.p1, self.p2))

    @property
    def valid(self) -> bool:
        """True if the distortion is invertible everywhere in the image."""
        rays = self.rays(_border(self.width, self.height))
        if not np.all(np.isfinite(rays)):
            return False
        shares = np.linspace(0.0, 1.0, BORDER_SAMPLES)
        radii = shares[:, None] * np.linalg.norm(rays, axis=1).max()
        squares = radii**2
        return bool(np.all(1 + 3 * self.k1 * squares + 5 * self.k2 * squares**2 > 0))

    def pixels(self, rays: ArrayLike) -> Array:
        """Project viewing rays (N, 2), given as x/z, y/z, to image points (N, 2), [px]."""
        bent = self._bent(np.asarray(rays, np.float64))
        return bent * [self.fx, self.fy] + [self.cx, self.cy]

    def rays(self, pixels: ArrayLike) -> Array:
        """Compute viewing rays (N, 2), as x/z, y/z, of image points (N, 2), [px]."""
        bent = (np.asarray(pixels, np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        rays = bent.copy()
        if self.bends:
            for _ in range(NEWTON_STEPS):
                rays = rays - np.einsum("nij,nj->ni", self._inverse_slope(rays), self._bent(rays) - bent)
        return rays

    def straight(self) -> "Lens":
        """Return the pinhole intrinsics of the undistorted image, which has the same size.

        The focal length is the smallest one at which every pixel of the undistorted image is inside the original image; the
        principal point is kept.
        """
        if not self.bends:
            return self
        rays = self.rays(_border(self.width, self.height)).reshape(4, -1, 2)
        top, right, bottom, left = rays[0], rays[1], rays[2], rays[3]
        scale = max(
            self.cx / (self.fx * -left[:, 0].max()),
            (self.width - self.cx) / (self.fx * right[:, 0].min()),
            self.cy / (self.fy * -top[:, 1].max()),
            (self.height - self.cy) / (self.fy * bottom[:, 1].min()),
        )
        return replace(self, fx=scale * self.fx, fy=scale * self.fy, k1=0.0, k2=0.0, p1=0.0, p2=0.0)

    def pinhole_camera(self, T_world_cam: ArrayLike) -> Camera:
        """Return the camera of the undistorted images at a pose (4, 4)."""
        straight = self.straight()
        return Camera(
            fx=straight.fx,
            fy=straight.fy,
            cx=straight.cx,
            cy=straight.cy,
            width=straight.width,
            height=straight.height,
            T_world_cam=np.asarray(T_world_cam, np.float64),
        )

    def undistort(self, pixels: ArrayLike) -> Array:
        """Convert image points (N, 2) to points (N, 2) of the undistorted image, [px]."""
        return self.straight().pixels(self.rays(pixels)) if self.bends else np.array(pixels, np.float64)

    def source_pixels(self) -> Array:
        """Compute the point in the original image (height, width, 2), [px], of every pixel of the undistorted image."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        centres = np.stack([u.ravel(), v.ravel()], 1)
        return self.pixels(self.straight().rays(centres)).reshape(self.height, self.width, 2)

    def largest_shift_px(self) -> float:
        """Compute the largest displacement that the distortion causes on the border of the image, [px]."""
        border = _border(self.width, self.height)
        plain = self.rays(border) * [self.fx, self.fy] + [self.cx, self.cy]
        return float(np.linalg.norm(plain - border, axis=1).max())

    def _bent(self, rays: Array) -> Array:
        x, y = rays[:, 0], rays[:, 1]
        square = x * x + y * y
        radial = 1 + square * (self.k1 + square * self.k2)
        return np.stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (square + 2 * x * x),
                y * radial + self.p1 * (square + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            1,
        )

    def _inverse_slope(self, rays: Array) -> Array:
        """Compute the inverse (N, 2, 2) of the derivative of `_bent`."""
        x, y = rays[:, 0], rays[:, 1]
        square = x * x + y * y
        radial = 1 + square * (self.k1 + square * self.k2)
        slope = self.k1 + 2 * self.k2 * square
        cross = 2 * x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y
        xx = radial + 2 * x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
        yy = radial + 2 * y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x
        determinant = xx * yy - cross * cross
        return np.stack([yy, -cross, -cross, xx], 1).reshape(-1, 2, 2) / determinant[:, None, None]


def _border(width: int, height: int) -> Array:
    """Sample points (4 * BORDER_SAMPLES, 2) on the top, right, bottom and left edge, [px]."""
    share: Array = np.linspace(0.0, 1.0, BORDER_SAMPLES, dtype=np.float64)
    zero, one = np.zeros_like(share), np.ones_like(share)
    edges = [(share, zero), (one, share), (share, one), (zero, share)]
    points = np.concatenate([np.stack([x, y], 1) for x, y in edges])
    return points * np.array([width, height], np.float64)


def undistorter(lens: Lens) -> Resample:
    """Make a function that undistorts images (H, W, 3) uint8 of a lens; the interpolation weights are computed once."""
    return resampler(lens.source_pixels())


def resampler(source_pixels: Array) -> Resample:
    """Make a function that resamples an image (H, W, 3) uint8 at points (H, W, 2), [px].

    Source: R. Keys, Cubic convolution interpolation (1981), a = -0.5.
    """
    height, width = source_pixels.shape[:2]
    weights = _cubic(source_pixels.reshape(-1, 2), (height, width))

    def resample(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        values = weights @ image.reshape(-1, image.shape[-1]).astype(np.float32)
        return np.clip(values + 0.5, 0, 255).astype(np.uint8).reshape(image.shape)

    return resample


def undistort_labels(labels: NDArray[np.uint8], lens: Lens) -> NDArray[np.uint8]:
    """Undistort a label image (H, W) by nearest-neighbor interpolation."""
    return resample_labels(labels, lens.source_pixels())


def resample_labels(labels: NDArray[np.uint8], source_pixels: Array) -> NDArray[np.uint8]:
    """Resample a label image (H, W) at the pixels nearest to points (H, W, 2), [px]."""
    height, width = labels.shape
    at = np.floor(source_pixels).astype(np.int64)
    return labels[np.clip(at[..., 1], 0, height - 1), np.clip(at[..., 0], 0, width - 1)]


def _cubic(pixels: Array, size: tuple[int, int]) -> csr_array:
    """Compute the weights (N, H * W) of the 16 pixels around each point; pixels on the border are repeated."""
    height, width = size
    corner = np.floor(pixels - 0.5).astype(np.int64)
    taps_x = _taps(pixels[:, 0] - 0.5 - corner[:, 0])
    taps_y = _taps(pixels[:, 1] - 0.5 - corner[:, 1])
    columns = np.clip(corner[:, :1] + np.arange(-1, 3), 0, width - 1)
    rows = np.clip(corner[:, 1:] + np.arange(-1, 3), 0, height - 1)
    weights = (taps_y[:, :, None] * taps_x[:, None, :]).astype(np.float32)
    indices = (rows[:, :, None] * width + columns[:, None, :]).astype(np.int32)
    starts = np.arange(0, 16 * len(pixels) + 1, 16, dtype=np.int32)
    return csr_array((weights.ravel(), indices.ravel(), starts), shape=(len(pixels), height * width))


def _taps(shares: Array) -> Array:
    """Compute the weights (N, 4) of the pixels at -1, 0, 1, 2 for points at `shares` (N,) between 0 and 1."""
    t = shares[:, None]
    return 0.5 * np.concatenate(
        [
            -t + 2 * t**2 - t**3,
            2 - 5 * t**2 + 3 * t**3,
            t + 4 * t**2 - 3 * t**3,
            -(t**2) + t**3,
        ],
        1,
    )
