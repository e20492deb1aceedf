"""Points of a part: where its Gaussians are solid."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.gaussians import Gaussians
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
