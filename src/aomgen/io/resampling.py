"""Resampling and undistorting images: the same image as a pinhole camera would have taken it."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from aomgen.core.lens import Lens
from aomgen.core.values import Array

Resample = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]


def undistorter(lens: Lens) -> Resample:
    """A function that undistorts images (H, W, 3) uint8 of one lens; the weights are made once."""
    return resampler(lens.source_pixels())


def resampler(source_pixels: Array) -> Resample:
    """A function that takes each pixel of an image (H, W, 3) uint8 from a point (H, W, 2), [px], of it.

    Source: R. Keys, Cubic convolution interpolation (1981), a = -0.5.
    """
    height, width = source_pixels.shape[:2]
    weights = _cubic(source_pixels.reshape(-1, 2), (height, width))

    def resample(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        values = weights @ image.reshape(-1, image.shape[-1]).astype(np.float32)
        return np.clip(values + 0.5, 0, 255).astype(np.uint8).reshape(image.shape)

    return resample


def undistort_labels(labels: NDArray[np.uint8], lens: Lens) -> NDArray[np.uint8]:
    """A label image (H, W) undistorted: every pixel takes the label of the nearest one."""
    return resample_labels(labels, lens.source_pixels())


def resample_labels(labels: NDArray[np.uint8], source_pixels: Array) -> NDArray[np.uint8]:
    """A label image (H, W) each of whose pixels is taken from the one at a point (H, W, 2), [px], of it."""
    height, width = labels.shape
    at = np.floor(source_pixels).astype(np.int64)
    return labels[np.clip(at[..., 1], 0, height - 1), np.clip(at[..., 0], 0, width - 1)]


def _cubic(pixels: Array, size: tuple[int, int]) -> csr_array:
    """Weights (N, H * W) of the 16 pixels around each point; the border's pixels are repeated."""
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
    """Weights (N, 4) of the pixels at -1, 0, 1, 2 for a point at `shares` (N,) between 0 and 1."""
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
