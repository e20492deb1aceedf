"""Points over which expectations of a normal distribution are averaged."""

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from aomgen.core.values import Array


def normal_points(count: int, size: int) -> Array:
    """Low-discrepancy points (count, size) of the standard normal distribution, the same at every call.

    Source: Halton, 1960. Their means converge nearly as 1 / count, those of random samples as its root.
    """
    return np.asarray(ndtri(qmc.Halton(size, scramble=False).random(count + 1)[1:]), np.float64)
