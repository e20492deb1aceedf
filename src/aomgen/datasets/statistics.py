"""Statistics that policies normalise with, in the form LeRobot v3.0 stores them."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.values import Array

# Those that LeRobot v3.0 stores for each feature.
QUANTILES: Final = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def column_statistics(values: ArrayLike) -> dict[str, list]:
    """min, max, mean, std, count and quantiles of each column of (T, D)."""
    data = np.asarray(values, np.float64)
    result = {"min": data.min(0), "max": data.max(0), "mean": data.mean(0), "std": data.std(0)}
    result |= {name: np.quantile(data, share, axis=0) for name, share in QUANTILES.items()}
    return {name: array.tolist() for name, array in result.items()} | {"count": [len(data)]}


def color_counts(frames: NDArray[np.uint8]) -> NDArray[np.int64]:
    """How often each value 0..255 occurs in each channel of frames (F, H, W, 3): (3, 256)."""
    return np.stack([np.bincount(frames[..., channel].ravel(), minlength=256) for channel in range(3)])


def image_statistics(counts: NDArray[np.int64], frames: int) -> dict[str, list]:
    """Statistics of the color channels in 0..1, each of shape (3, 1, 1).

    Args:
        counts: (3, 256) from `color_counts`, at least one pixel.
        frames: Number of frames that the counts stand for.
    """
    levels = np.arange(256) / 255
    shares = counts / counts.sum(1, keepdims=True)
    mean = shares @ levels
    std = np.sqrt(np.maximum(shares @ levels**2 - mean**2, 0))
    cumulated = np.cumsum(shares, 1)

    def level(share: float) -> Array:
        return np.array([levels[min(int(np.searchsorted(row, share)), 255)] for row in cumulated])

    present = counts > 0
    result = {"min": levels[present.argmax(1)], "max": levels[255 - present[:, ::-1].argmax(1)]}
    result |= {"mean": mean, "std": std} | {name: level(share) for name, share in QUANTILES.items()}
    return {name: array.reshape(3, 1, 1).tolist() for name, array in result.items()} | {"count": [frames]}
