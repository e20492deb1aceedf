"""Middle and spread that a few outliers do not change."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Standard deviations in a median absolute deviation of normal noise: 1 / (inverse normal distribution at 3/4).
SD_OF_MAD: Final = 1.4826


def robust_sd(deviations: ArrayLike) -> float:
    """Standard deviation of normal noise with these deviations from its middle, by their median size."""
    return SD_OF_MAD * float(np.median(np.abs(deviations)))


def masked_median(values: NDArray, known: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Median (...) over the first axis of values (N, ...) where they are known, 0 where none is, and where one is.

    `known` (N, ...) may lack trailing axes of the values, for example their color channels.
    """
    known = np.asarray(known)
    missing = np.expand_dims(~known, tuple(range(known.ndim, values.ndim)))
    bare = np.where(missing, np.float32(np.nan), values.astype(np.float32))
    some = np.asarray(known.any(axis=0))
    bare[:, ~some] = 0
    return np.asarray(np.nanmedian(bare, axis=0), np.float32), some
