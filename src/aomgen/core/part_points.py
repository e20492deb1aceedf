"""Points of a part: where its Gaussians are solid."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import matrix_from_quat
from aomgen.core.values import Array

# Gaussians fainter than this are haze, not surface.
SOLID_OPACITY: Final = 0.3


def surface_points(gaussians: Gaussians, labels: NDArray[np.uint8], label: int) -> Array:
    """Centres (N, 3) of a part's solid Gaussians, in their frame.

    Args:
        gaussians: The scene (G).
        labels: Part label of every Gaussian (G,), see `conventions`.
        label: The part.
    """
    return np.asarray(gaussians.means[(labels == label) & (gaussians.opacities > SOLID_OPACITY)], np.float64)


def spread_points(gaussians: Gaussians, labels: NDArray[np.uint8], label: int, spacing_m: float) -> Array:
    """Points (N, 3) along the longest axis of each of a part's solid Gaussians, in their frame.

    A thin bar is made of few long Gaussians, whose centres alone leave it full of gaps.

    Args:
        gaussians: The scene (G).
        labels: Part label of every Gaussian (G,), see `conventions`.
        label: The part.
        spacing_m: Distance of neighboring points; each Gaussian reaches one standard deviation, [m].
    """
    part = gaussians.select((labels == label) & (gaussians.opacities > SOLID_OPACITY))
    longest = np.argmax(part.scales, axis=1)
    rows = np.arange(len(part))
    reach = part.scales[rows, longest].astype(np.float64)
    axes = matrix_from_quat(part.quats.astype(np.float64))[rows, :, longest]
    steps = np.floor(reach / spacing_m).astype(int)
    counts = 2 * steps + 1
    owners = np.repeat(rows, counts)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) - steps[owners]
    return part.means.astype(np.float64)[owners] + (number * spacing_m)[:, None] * axes[owners]
