"""Spread that a few outliers do not change."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

# Standard deviations in a median absolute deviation of normal noise: 1 / (inverse normal distribution at 3/4).
SD_OF_MAD: Final = 1.4826


def robust_sd(deviations: ArrayLike) -> float:
    """Standard deviation of normal noise with these deviations from its middle, by their median size."""
    return SD_OF_MAD * float(np.median(np.abs(deviations)))
