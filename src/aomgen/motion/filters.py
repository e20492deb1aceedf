"""The few scipy filters that motion needs, with plain array types."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.signal import savgol_filter

from aomgen.core.values import Array


def smooth(values: Array, step_s: float, window_s: float) -> Array:
    """Savitzky-Golay smoothed series (T,), second order, at least five samples wide."""
    window = max(5, 2 * round(window_s / step_s / 2) + 1)
    return np.asarray(savgol_filter(values, window, 2)) if len(values) > window else np.array(values)


def remove_glitches(values: Array) -> Array:
    """Series (T,) in which single samples that stand out are replaced: the median of three."""
    return np.asarray(ndimage.median_filter(values, 3, mode="nearest"))


def dilate(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """A mask (H, W) with a margin added."""
    return np.asarray(ndimage.binary_dilation(mask, iterations=pixels), bool)


def close_gaps(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """A mask (H, W) with gaps up to twice `pixels` closed."""
    return np.asarray(ndimage.binary_closing(mask, iterations=pixels, border_value=0), bool)


def minimum_around(values: Array, pixels: int) -> Array:
    """The smallest value (H, W) in a square of `pixels` around each pixel."""
    return np.asarray(ndimage.minimum_filter(values, size=pixels))


def fill_holes(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask (H, W) without holes."""
    return np.asarray(ndimage.binary_fill_holes(mask), bool)


def keep_touching(mask: NDArray[np.bool_], seed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Connected regions of a mask (H, W), diagonals included, that meet the seed (H, W)."""
    return np.asarray(ndimage.binary_propagation(seed & mask, np.ones((3, 3)), mask), bool)
