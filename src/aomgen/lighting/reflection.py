"""Appearance of a new object's surfaces in a scene's light: diffuse color and view-dependent reflection.

The harmonics of the reflected light are those of the arriving light after mirroring at the surface and blurring according
to the roughness. Reflectance increases at grazing angles, less on rough surfaces. Gaussians store the harmonics of the
reflection in addition to their color, in the frame of their link. These are exact at the pose of the recorded object and
rotate with the part; the error from rotations about the vertical is small, because most light comes from above.

Source: Schlick 1994 (reflectance by angle); Lagarde 2011 (reflectance of rough surfaces).
"""

from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np

from aomgen.conventions import linear_from_srgb, srgb_from_linear
from aomgen.core.gaussians import SH_C0
from aomgen.core.light import rotate_radiance
from aomgen.core.sh import sh_basis, sphere_directions
from aomgen.core.values import Array
from aomgen.lighting.light_estimation import REFLECTED, SceneLight
from aomgen.splatting.surfels import Surfels

# Band of each of the nine spherical harmonics.
BANDS: Final = np.repeat([0, 1, 2], [1, 3, 5])
# Viewing directions for a surface with the normal z; the surface is visible in half of them.
VIEWS: Final = sphere_directions(128)
# Weight of views from behind the surface, without which the harmonics would be arbitrary in these directions.
BACK: Final = 0.02
# Lower bound of linear received light in divisions, so that small differences are not amplified.
BLACK: Final = 0.002


def show_in_light(surfels: Surfels, light: SceneLight, R_world_asset: Array) -> Surfels:
    """Compute the appearance of a link's surfels in a light, asset frame at joint value 0.

    The albedo becomes that of a diffuse surface with the same mean color; the harmonics of the Gaussians represent the
    deviation of the color from its mean.

    Args:
        surfels: Surfels of the link.
        light: Light at the object.
        R_world_asset: Orientation of the asset (3, 3).
    """
    radiance, shown = (part.view_from(R_world_asset) for part in (light.arriving, light.shown))
    metallic = surfels.metallic[:, None].astype(np.float64)
    colors = surfels.albedo_linear.astype(np.float64)
    share = REFLECTED * (1 - metallic) + metallic * colors
    # The constant coefficient of an unoccluded surface's transfer is the constant harmonic.
    open_ = np.clip(surfels.transfer[:, :1] / SH_C0, 0, 1)
    roughness = surfels.roughness[:, None].astype(np.float64)
    # The width of a GGX microfacet lobe is the square of the roughness.
    blur = np.exp(-((BANDS * roughness**2) ** 2))
    half_turns = _to_upright(surfels.shading_normals.astype(np.float64))
    above = blur[..., None] * rotate_radiance(radiance, half_turns)
    views, fit = _views()
    mirrored = np.maximum(sh_basis(views * (1, 1, -1), 2) @ above, 0)
    # This is the angle-dependent part of Schlick's reflectance for every view, reduced by the roughness.
    more = (np.maximum(1 - roughness, share) - share)[:, None] * (1 + views[:, 2:]) ** 5
    transfer = surfels.transfer.astype(np.float64)
    diffuse = colors * (1 - metallic) * np.maximum(transfer @ radiance, 0)
    sent = diffuse[:, None] + open_[..., None] * (share[:, None] + more) * mirrored
    colors_srgb = srgb_from_linear(np.minimum(light.tone.show(sent), 1))
    sh = rotate_radiance(fit @ colors_srgb, half_turns).astype(np.float32)
    albedo = linear_from_srgb(np.clip(SH_C0 * sh[:, 0], 0, 1)) / np.maximum(transfer @ shown, BLACK)
    sh[:, 0] = surfels.gaussians.sh[:, 0]
    return replace(surfels, gaussians=surfels.gaussians.with_sh(sh), albedo_linear=albedo.astype(np.float32))


def _to_upright(normals: Array) -> Array:
    """Compute rotations by 180 degrees (N, 3, 3) that swap normals (N, 3) and the z axis."""
    between = normals + (0, 0, 1)
    between[np.linalg.norm(between, axis=1) < 1e-3] = (1, 0, 0)
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    return 2 * between[:, :, None] * between[:, None] - np.eye(3)


@cache
def _views() -> tuple[Array, Array]:
    """Return the K viewing directions (K, 3) from which a surface is visible, and a matrix (9, K) that fits harmonics.

    Each view is weighted by the projected area of the surface. In directions from which it is invisible, the harmonics are
    kept near the mean.
    """
    views, hidden = VIEWS[VIEWS[:, 2] < 0], VIEWS[VIEWS[:, 2] >= 0]
    weights = -views[:, 2] / -views[:, 2].sum()
    held = np.full(len(hidden), np.sqrt(BACK / len(hidden)))
    basis = np.concatenate(
        [np.sqrt(weights)[:, None] * sh_basis(views, 2), held[:, None] * sh_basis(hidden, 2)]
    )
    wanted = np.concatenate([np.diag(np.sqrt(weights)), np.outer(held, weights)])
    return views, np.asarray(np.linalg.pinv(basis) @ wanted, np.float64)
