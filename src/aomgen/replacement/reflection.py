"""What a new object's surfaces show of a scene's light: colors as its camera shows them, and reflections.

A reflection is a function of where a surface is seen from. Mirrored at the surface, the harmonics of the light are those
of what is seen in it, blurred by roughness; Gaussians keep them beside their color, in the frame of their link. They are
right where the object was recorded and turn with the part: about the vertical little changes, because light comes from above.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from aomgen.conventions import srgb_from_linear
from aomgen.core.gaussians import SH_C0
from aomgen.core.light import turned_radiance
from aomgen.core.values import Array
from aomgen.replacement.light_estimation import REFLECTED, SceneLight, lose_color
from aomgen.splatting.surfels import Surfels

# Band of each of the nine harmonics.
BANDS: Final = np.repeat([0, 1, 2], [1, 3, 5])
# The slope of sRGB is taken above this, linear: nearer to black it would make small differences large.
BLACK: Final = 0.002
# Step of the slope, as a share.
STEP: Final = 0.05


def show_in_light(surfels: Surfels, light: SceneLight, R_world_asset: Array) -> Surfels:
    """Surfels of a link as they look in a light, asset frame at joint value 0.

    The albedo becomes what a diffuse surface would need to look alike on the whole; harmonics of the Gaussians add how
    the reflection differs from its mean.
    """
    radiance = light.light.seen_from(R_world_asset)
    metallic = surfels.metallic[:, None].astype(np.float64)
    colors = lose_color(surfels.albedo_linear.astype(np.float64), light.color_loss)
    share = REFLECTED * (1 - metallic) + metallic * colors
    # The constant part of an open surface's transfer is the constant harmonic.
    open_ = np.clip(surfels.transfer[:, :1] / SH_C0, 0, 1)
    mirrored = _mirror(radiance, surfels.shading_normals.astype(np.float64))
    # Lobes of microfacets: a GGX width of the square of the roughness.
    blur = np.exp(-((BANDS * surfels.roughness[:, None].astype(np.float64) ** 2) ** 2))
    reflection = (share * open_)[:, None] * blur[..., None] * mirrored
    arriving = np.maximum(surfels.transfer.astype(np.float64) @ radiance, BLACK)
    sent = colors * (1 - metallic) * arriving + np.maximum(reflection[:, 0] * SH_C0, 0)
    sent = np.clip(sent, BLACK, 1 / (1 + STEP))
    slope = (srgb_from_linear(sent * (1 + STEP)) - srgb_from_linear(sent * (1 - STEP))) / (2 * STEP * sent)
    sh = np.zeros((len(sent), 9, 3), np.float32)
    sh[:, 0] = surfels.gaussians.sh[:, 0]
    sh[:, 1:] = reflection[:, 1:] * slope[:, None]
    albedo = sent / arriving
    return replace(surfels, gaussians=surfels.gaussians.with_sh(sh), albedo_linear=albedo.astype(np.float32))


def _mirror(radiance: Array, normals: Array) -> Array:
    """Harmonics (N, 9, 3), by the direction in which a surface is seen, of what mirrors with normals (N, 3) show."""
    # A mirror is half a turn about its normal and a point reflection, which changes the sign of odd bands.
    half_turns = 2 * normals[:, :, None] * normals[:, None] - np.eye(3)
    return np.where(BANDS % 2, -1.0, 1.0)[:, None] * turned_radiance(radiance, half_turns)
