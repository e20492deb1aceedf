"""Light as radiance from directions, its spherical harmonics, and the irradiance of surfaces.

Nine harmonics of the radiance determine the shading of a diffuse surface. A surface point stores the irradiance that each
harmonic causes there (its *transfer*), so that the shading of a rotated body is one dot product.

Source: Ramamoorthi & Hanrahan 2001 (nine coefficients suffice for diffuse shading); Sloan, Kautz & Snyder 2002
(precomputed transfer).
"""

from dataclasses import dataclass, replace
from typing import Annotated, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.sh import sh_basis, sh_rotation, sphere_directions
from aomgen.core.transforms import make_tangent_basis
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays

# Factors that convert radiance coefficients of bands 0, 1, 2 to irradiance coefficients.
COSINE_BANDS: Final = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4], [1, 3, 5])
# Number of directions that represent light from all directions; the irradiance is then accurate to a thousandth.
DIRECTIONS: Final = 256
# Number of directions in the ring around the center of a wide directional light.
RING: Final = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """Light that arrives from D directions, in the exposure of the scene's images.

    Attributes:
        directions: Unit vectors (D, 3) toward the light, world frame.
        radiance: Linear RGB (D, 3) that a white diffuse surface reflects if it faces the direction: radiance times solid
            angle over pi; 1 is image white.
    """

    directions: Annotated[Array, "D 3"]
    radiance: Annotated[Array, "D _"]

    __post_init__ = freeze_arrays

    @property
    def radiance_sh(self) -> Array:
        """Spherical harmonics (9, 3) of the radiance, world frame."""
        return np.pi * sh_basis(self.directions, 2).T @ self.radiance

    def irradiance(self, normals: ArrayLike, visibility: ArrayLike = 1.0) -> Array:
        """Compute the irradiance over pi (N, 3) of surfaces, which is the linear RGB that white diffuse surfaces reflect.

        Args:
            normals: Unit normals (N, 3), world frame.
            visibility: Share (N, D) of each direction's light that reaches the surface, 0..1.
        """
        cosines = np.maximum(np.asarray(normals, np.float64) @ self.directions.T, 0)
        return np.asarray((cosines * np.asarray(visibility)) @ self.radiance, np.float64)

    def view_from(self, R_world_body: ArrayLike) -> Array:
        """Compute the harmonics (..., 9, 3) in the frames of bodies with orientations (..., 3, 3)."""
        return rotate_radiance(self.radiance_sh, R_world_body)

    def scale_by(self, gain: ArrayLike) -> "Light":
        """Multiply the radiance by a factor, or by one factor per channel (3,)."""
        return replace(self, radiance=self.radiance * np.asarray(gain, np.float64))

    def turn(self, R: ArrayLike) -> "Light":
        """Rotate all directions by a rotation (3, 3)."""
        return replace(self, directions=self.directions @ np.asarray(R, np.float64).T)


@dataclass(frozen=True, slots=True, kw_only=True)
class DirectionalLight:
    """The part of a horizontal surface's light that comes from one direction and casts visible shadows.

    Attributes:
        directions: Unit vectors (K, 3) toward the light, world frame; one for sharp shadows, see `spread_directions`.
        share: Share (3,) of this light in the surface's irradiance, linear RGB, 0..1.
        T_world_plane: Pose of the surface (4, 4), on which z = 0.
    """

    directions: Annotated[Array, "K 3"]
    share: Vector3
    T_world_plane: Matrix4

    def __post_init__(self) -> None:
        freeze_arrays(self)
        if not np.allclose(np.linalg.norm(self.directions, axis=1), 1, atol=1e-6):
            raise ValueError("DirectionalLight.directions have not length 1")
        if not ((self.share >= 0) & (self.share < 1)).all():
            raise ValueError("DirectionalLight.share is not in 0..1")

    def split(self, light: Light) -> tuple[Light, Light]:
        """Split the total light at the surface into light from all directions and this light, in that order."""
        up = self.T_world_plane[:3, 2]
        total = light.irradiance(up[None])[0]
        radiance = self.share * total / max(float((self.directions @ up).sum()), 1e-9)
        own = Light(directions=self.directions, radiance=np.tile(radiance, (len(self.directions), 1)))
        rest = light_from_harmonics(light.radiance_sh - own.radiance_sh)
        # Nine harmonics of a single direction are negative in other directions, which light cannot be.
        rest = replace(rest, radiance=np.maximum(rest.radiance, 0))
        return rest.scale_by((1 - self.share) * total / np.maximum(rest.irradiance(up[None])[0], 1e-9)), own


def spread_directions(direction: ArrayLike, width: float) -> Array:
    """Spread directions (K, 3) over a disc with the half-angle `width`, [rad], around one direction (3,): center and ring."""
    center = np.asarray(direction, np.float64)
    if not width:
        return center[None]
    turns = np.arange(RING) * 2 * np.pi / RING
    ring = np.stack([np.cos(turns), np.sin(turns)], 1) @ make_tangent_basis(center)
    # Ring and center together have the second moment of the disc.
    spread = np.concatenate([center[None], center + np.tan(width) * np.sqrt((RING + 1) / (2 * RING)) * ring])
    return spread / np.linalg.norm(spread, axis=1, keepdims=True)


def light_from_harmonics(radiance_sh: ArrayLike) -> Light:
    """Make light from all directions whose radiance has the harmonics (9, 3); it is negative where their sum is."""
    directions = sphere_directions(DIRECTIONS)
    # This is the smallest radiance with exactly these harmonics; it equals their sum except for quadrature errors.
    weights = np.linalg.pinv(np.pi * sh_basis(directions, 2).T)
    return Light(directions=directions, radiance=weights @ np.asarray(radiance_sh, np.float64))


def hemisphere_light(sky: ArrayLike, ground: ArrayLike) -> Light:
    """Make the light of two hemispheres with radiance (3,) from above and from below, by bands 0 and 1."""
    sky, ground = np.asarray(sky, np.float64), np.asarray(ground, np.float64)
    sh = np.zeros((9, 3))
    # Projections of the two hemispheres are Y0 * 2 pi each for band 0, and +-pi * 0.4886 for the z harmonic of band 1.
    sh[0] = 0.28209479177387814 * 2 * np.pi * (sky + ground)
    sh[2] = 0.4886025119029199 * np.pi * (sky - ground)
    return light_from_harmonics(sh)


def rotate_radiance(radiance_sh: ArrayLike, R_world_body: ArrayLike) -> Array:
    """Rotate harmonics (9, C) from the world frame to the frames (..., 3, 3) of bodies; returns (..., 9, C)."""
    Rs_body_world = np.asarray(R_world_body, np.float64).swapaxes(-1, -2)
    radiance = np.asarray(radiance_sh)
    radiance = np.broadcast_to(radiance, (*Rs_body_world.shape[:-2], *radiance.shape[-2:]))
    turned = [
        matrix @ radiance[..., band * band : (band + 1) ** 2, :]
        for band, matrix in enumerate(sh_rotation(Rs_body_world, 2), start=1)
    ]
    return np.concatenate([radiance[..., :1, :], *turned], -2)


def project_radiance(directions: ArrayLike, solid_angles: ArrayLike, radiance: ArrayLike) -> Array:
    """Project radiance (D, ...) to harmonics (9, ...).

    Args:
        directions: Unit directions (D, 3).
        solid_angles: Solid angle of each direction (D,), or of all, [sr].
        radiance: Radiance from each direction (D, ...).
    """
    weighted = sh_basis(directions, 2) * np.asarray(solid_angles)[..., None]
    return np.asarray(weighted.T @ np.asarray(radiance), np.float64)


def open_transfer(normals: ArrayLike) -> NDArray[np.float32]:
    """Compute the transfer (N, 9) of unoccluded surfaces with unit normals (N, 3).

    The product of transfer and radiance harmonics is irradiance over pi.
    """
    return (sh_basis(normals, 2) * (COSINE_BANDS / np.pi)).astype(np.float32)
