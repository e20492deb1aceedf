"""Gaussians that a face of the fitted boxes passes through are cut in two.

Gaussians on a plain front are large and lie across the seam around a drawer or a door. With one label they
would drag a strip of the body along when the part moves. Each half is the moment match of the Gaussian
truncated at the face: its mean and covariance, its weight kept, so that images of the scan stay.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from aomgen.core.gaussians import Gaussians, concatenate, gaussians_of
from aomgen.core.parts import Cut
from aomgen.core.transforms import matrix_from_quat, quat_from_matrix
from aomgen.core.values import Array
from aomgen.parts.panel import Panel

# A face cuts Gaussians of which it leaves this share on either side, at least.
MIN_SHARE = 0.1
# Opacities end below 1: a Gaussian never blocks all light.
MAX_OPACITY = 0.999


def cut_at_faces(gaussians: Gaussians, panel: Panel, free: NDArray[np.bool_]) -> Cut:
    """Cut Gaussians whose halves lie in different parts.

    Args:
        gaussians: World frame.
        panel: The boxes.
        free: Which Gaussians (N,) may be cut.
    """
    origins = np.flatnonzero(free)
    pieces, cut = gaussians.select(origins), np.zeros(len(origins), bool)
    for normal, offset in panel.faces():
        crossed = np.flatnonzero(_least_share(pieces, normal, offset) > MIN_SHARE)
        above, below = (_half(pieces.select(crossed), side * normal, side * offset) for side in (1, -1))
        apart = panel.labels(above.means) != panel.labels(below.means)
        divided = crossed[apart]
        whole = np.ones(len(pieces), bool)
        whole[divided] = False
        pieces = concatenate([pieces.select(whole), above.select(apart), below.select(apart)])
        origins = np.concatenate([origins[whole], origins[divided], origins[divided]])
        cut = np.concatenate([cut[whole], np.ones(2 * len(divided), bool)])
    return Cut(sources=origins[cut], pieces=pieces.select(cut))


def _covariances(gaussians: Gaussians) -> Array:
    axes = matrix_from_quat(gaussians.quats) * gaussians.scales[:, None, :].astype(np.float64)
    return axes @ np.swapaxes(axes, 1, 2)


def _least_share(gaussians: Gaussians, normal: Array, offset: float) -> Array:
    """Share (N,) of each Gaussian on the emptier side of the plane `normal @ x = offset`."""
    widths = np.linalg.norm(
        gaussians.scales * (normal @ matrix_from_quat(gaussians.quats)).astype(np.float64), axis=1
    )
    return norm.cdf(-np.abs(gaussians.means @ normal - offset) / np.maximum(widths, 1e-12))


def _half(gaussians: Gaussians, normal: Array, offset: float) -> Gaussians:
    """What lies above the plane `normal @ x = offset`, as Gaussians of the same mean and covariance.

    Source: moments of the truncated normal distribution, along the normal.
    """
    covariances = _covariances(gaussians)
    along = covariances @ normal
    variances = along @ normal
    widths = np.sqrt(variances)
    height = (gaussians.means.astype(np.float64) @ normal - offset) / widths
    share = norm.cdf(height)
    shift = norm.pdf(height) / share
    narrowed = 1 - shift * (shift + height)
    means = gaussians.means + (shift / widths)[:, None] * along
    outer = along[:, :, None] * along[:, None, :]
    squares, axes = np.linalg.eigh(covariances - ((1 - narrowed) / variances)[:, None, None] * outer)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    return gaussians_of(
        means=means,
        quats=quat_from_matrix(axes),
        scales=np.sqrt(np.maximum(squares, 0)),
        opacities=np.minimum(gaussians.opacities * share / np.sqrt(narrowed), MAX_OPACITY),
        sh=gaussians.sh,
    )
