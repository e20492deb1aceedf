"""Light of a scene and how a diffuse surface answers to it.

Radiance is a function on the sphere, kept as nine spherical harmonics; a surface point keeps
the projection of its clamped, occluded cosine (its *transfer*), so that the light it sends back
is one dot product, also after it has turned.

Source: Ramamoorthi & Hanrahan 2001 (nine coefficients suffice for diffuse shading); Sloan,
Kautz & Snyder 2002 (precomputed transfer).
"""

from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.sh import sh_basis, sh_rotation
from aomgen.core.values import Array, freeze_arrays

# Factors that turn radiance coefficients of bands 0, 1, 2 into irradiance coefficients.
COSINE_BANDS: Final = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4], [1, 3, 5])


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """Radiance that arrives from all directions, exposed like the scene's pictures.

    Attributes:
        radiance_sh: (9, 3) coefficients of linear RGB radiance, world frame. A white diffuse
            surface under it sends back `irradiance / pi` of linear color, 1 = image white.
    """

    radiance_sh: Annotated[Array, "9 3"]

    __post_init__ = freeze_arrays

    def irradiance(self, normals_world: ArrayLike) -> Array:
        """Irradiance over pi (N, 3) of unoccluded surfaces with unit normals (N, 3)."""
        return np.maximum(cosine_answer(normals_world) @ self.radiance_sh, 0)

    def view_from(self, R_world_body: ArrayLike) -> Array:
        """Coefficients (..., 9, 3) in the frames of bodies turned by (..., 3, 3)."""
        return rotate_radiance(self.radiance_sh, R_world_body)

    def scale_by(self, gain: ArrayLike) -> "Light":
        """The light made brighter by a factor, or by three, one for each channel."""
        return Light(radiance_sh=self.radiance_sh * np.asarray(gain, np.float64))

    def without(self, direction: ArrayLike, normal: ArrayLike, share: float) -> "Light":
        """What is left without a lamp in a direction (3,) that sends a surface with a normal (3,) a share of its light."""
        towards, up = np.asarray(direction)[None], np.asarray(normal)[None]
        lamp = sh_basis(towards, 2).T * self.irradiance(up)
        lamp *= share / (cosine_answer(up) @ sh_basis(towards, 2).T)
        return Light(radiance_sh=self.radiance_sh - lamp)


def rotate_radiance(radiance_sh: ArrayLike, R_world_body: ArrayLike) -> Array:
    """Coefficients (..., 9, C) in the frames of bodies turned by (..., 3, 3) of radiance (9, C), or one each, in the world's."""
    Rs_body_world = np.asarray(R_world_body, np.float64).swapaxes(-1, -2)
    radiance = np.asarray(radiance_sh)
    radiance = np.broadcast_to(radiance, (*Rs_body_world.shape[:-2], *radiance.shape[-2:]))
    turned = [
        matrix @ radiance[..., band * band : (band + 1) ** 2, :]
        for band, matrix in enumerate(sh_rotation(Rs_body_world, 2), start=1)
    ]
    return np.concatenate([radiance[..., :1, :], *turned], -2)


def project_radiance(directions: ArrayLike, solid_angles: ArrayLike, radiance: ArrayLike) -> Array:
    """Harmonics (9, ...) of radiance (D, ...) from unit directions (D, 3) of solid angles (D,) or one for all, [sr]."""
    weighted = sh_basis(directions, 2) * np.asarray(solid_angles)[..., None]
    return np.asarray(weighted.T @ np.asarray(radiance), np.float64)


def hemisphere_light(sky: ArrayLike, ground: ArrayLike) -> Light:
    """Light of two half spheres: radiance (3,) from above and from below, bands 0 and 1."""
    sky, ground = np.asarray(sky, np.float64), np.asarray(ground, np.float64)
    sh = np.zeros((9, 3))
    # Projections of the two half spheres: Y0 * 2 pi each, and +-pi * 0.4886 for the z band.
    sh[0] = 0.28209479177387814 * 2 * np.pi * (sky + ground)
    sh[2] = 0.4886025119029199 * np.pi * (sky - ground)
    return Light(radiance_sh=sh)


def cosine_answer(normals: ArrayLike) -> Array:
    """Matrix (N, 9) that turns harmonics of radiance into irradiance over pi at unoccluded unit normals (N, 3)."""
    return sh_basis(normals, 2) * (COSINE_BANDS / np.pi)


def open_transfer(normals: ArrayLike) -> NDArray[np.float32]:
    """Transfer (N, 9) of unoccluded surfaces with unit normals (N, 3)."""
    return cosine_answer(normals).astype(np.float32)
