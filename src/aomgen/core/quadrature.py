"""Quadrature points for means over a normal distribution."""

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from aomgen.core.values import Array


def normal_points(count: int, size: int) -> Array:
    """Return deterministic low-discrepancy points (count, size) of the standard normal distribution.

    The error of means over these points decreases almost as 1 / count, that of random samples as 1 / sqrt(count).

    Source: Halton, 1960.
    """
    return np.asarray(ndtri(qmc.Halton(size, scramble=False).random(count + 1)[1:]), np.float64)
