"""Robust estimates of location, scale and linear coefficients."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.values import Array

# Ratio of standard deviation to median absolute deviation of normal noise: 1 / (inverse normal distribution at 3/4).
SD_OF_MAD: Final = 1.4826
# Residuals beyond this multiple of the standard deviation have little weight.
OUTLIER_SD: Final = 2.5
# Number of iterations of reweighted least squares; further iterations change the weights little.
_REWEIGHTINGS: Final = 5


def robust_sd(deviations: ArrayLike) -> float:
    """Estimate the standard deviation of normal noise from the median of the absolute deviations."""
    return SD_OF_MAD * float(np.median(np.abs(deviations)))


def compute_masked_median(
    values: NDArray[np.floating | np.integer], known: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Compute the median (...) of the known values (N, ...) over the first axis, and a mask of medians that exist.

    The median is 0 if no value is known.

    Args:
        values: Values (N, ...).
        known: Mask (N, ...) of the known values; trailing axes, for example color channels, may be omitted.
    """
    known = np.asarray(known)
    missing = np.expand_dims(~known, tuple(range(known.ndim, values.ndim)))
    bare = np.where(missing, np.float32(np.nan), values.astype(np.float32))
    some = np.asarray(known.any(axis=0))
    bare[:, ~some] = 0
    return np.asarray(np.nanmedian(bare, axis=0), np.float32), some


def weigh(residuals: Array, sd: float) -> Array:
    """Compute the robust weights of residuals; a residual of 0 has the weight 1. Source: Geman and McClure, 1987."""
    return 1 / (1 + (residuals / (OUTLIER_SD * sd)) ** 2) ** 2


def regress(columns: Array, targets: Array, weights: Array) -> Array:
    """Fit coefficients (N, ...) by weighted least squares, slightly regularized toward 0.

    Args:
        columns: Columns (P, N).
        targets: Targets (P, ...).
        weights: Weights (P,).
    """
    weighted = columns * weights[:, None]
    normal = weighted.T @ columns
    normal += (1e-3 * np.trace(normal) + 1e-9) * np.eye(len(normal))
    return np.asarray(np.linalg.solve(normal, weighted.T @ targets), np.float64)


def regress_robustly(columns: Array, target: Array, least_sd: float) -> tuple[Array, Array, float]:
    """Fit coefficients of columns (P, N) to a target (P,) by iteratively reweighted least squares.

    Args:
        columns: Columns (P, N).
        target: Target (P,).
        least_sd: Lower bound of the residuals' standard deviation.

    Returns:
        Coefficients (N,), weights (P,), and the standard deviation of the residuals.
    """
    weights, coefficients, sd = np.ones(len(target)), np.zeros(columns.shape[1]), least_sd
    for _ in range(_REWEIGHTINGS):
        coefficients = regress(columns, target, weights)
        residuals = target - columns @ coefficients
        sd = max(robust_sd(residuals), least_sd)
        weights = weigh(residuals, sd)
    return coefficients, weights, sd
