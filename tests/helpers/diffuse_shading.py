"""Colors of diffuse surfaces by definition, as reference for the fast methods of the renderers."""

import numpy as np
from numpy.typing import ArrayLike

from aomgen.conventions import srgb_from_linear
from aomgen.core.values import Array


def shaded_srgb(albedo_linear: ArrayLike, transfer: ArrayLike, radiance_sh: ArrayLike) -> Array:
    """Compute the sRGB colors (N, 3), 0..1, of diffuse surfaces.

    Args:
        albedo_linear: (N, 3), 0..1.
        transfer: (N, 9), in the frame of `radiance_sh`.
        radiance_sh: (9, 3), linear.
    """
    exitant = np.einsum("nk,kc->nc", np.asarray(transfer, np.float32), np.asarray(radiance_sh, np.float32))
    exitant = np.maximum(exitant, 0)
    return np.asarray(srgb_from_linear(np.minimum(np.asarray(albedo_linear) * exitant, 1.0)), np.float64)
