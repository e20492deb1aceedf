"""Metrics of the similarity of two images."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d


def psnr(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Compute the peak signal-to-noise ratio of images of one shape with values in 0..1, [dB]; infinite for equal images."""
    error = float(np.mean((np.asarray(a, np.float64) - np.asarray(b, np.float64)) ** 2))
    return float("inf") if error == 0 else -10 * float(np.log10(error))


def ssim(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Compute the mean structural similarity of images (H, W, C) with values in 0..1.

    The window is an 11x11 Gaussian of sigma 1.5, with zeros outside the image, as in the 3DGS evaluations.

    Raises:
        ValueError: The shapes differ or are not (H, W, C).

    Source: Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004.
    """
    x, y = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if x.shape != y.shape or x.ndim != 3:
        raise ValueError(f"images have shapes {x.shape} and {y.shape}, expected the same (H, W, C)")
    taps = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    taps /= taps.sum()

    def blur(image: NDArray) -> NDArray:
        rows = correlate1d(image, taps, axis=0, mode="constant")
        return correlate1d(rows, taps, axis=1, mode="constant")

    u, v = blur(x), blur(y)
    var_x, var_y, cov = blur(x * x) - u * u, blur(y * y) - v * v, blur(x * y) - u * v
    c1, c2 = 0.01**2, 0.03**2
    index = (2 * u * v + c1) * (2 * cov + c2) / ((u * u + v * v + c1) * (var_x + var_y + c2))
    return float(index.mean())
