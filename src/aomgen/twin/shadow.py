"""What one strong light sees of bodies, and the shadows that these throw.

Whether a point is in shadow is read off an image of the bodies taken from the light (shadow
mapping: Williams 1978, "Casting curved shadows on curved surfaces").
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from aomgen.conventions import SRGB_POWER
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import apply, invert, transform
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays
from aomgen.splatting.rasterizer import RigidParts, render

# Distance of a camera whose image counts as an orthographic one, [m].
FAR: Final = 60.0
# Longer side of the image from a light, [px]: a few millimeters each for an arm's shadow.
MAP_SIDE: Final = 384
# Heights over which a seen point fades in and out of the surface, [m]. Depth of trained
# surfaces is uncertain, mostly downwards, because lower Gaussians shine through.
HEIGHTS: Final = (-0.09, -0.06, 0.012, 0.03)
# Directions around the middle of a wide light.
RING: Final = 6
# The role of Gaussians for shadows: what they fall on, what throws one that is always the same, and what throws one
# that comes and goes.
SCENE, STANDS, MOVES = range(3)


@dataclass(frozen=True, slots=True, kw_only=True)
class DirectionalLight:
    """A light that throws shadows on a level surface.

    Attributes:
        direction: Unit, from the scene to the middle of the light, world frame.
        width: Half the angle under which the light is seen, [rad]; 0 for one that throws crisp shadows.
        T_world_plane: The surface, z = 0 on it.
        shade: Color in shadow divided by color in light, sRGB, 0..1.
    """

    direction: Vector3
    width: float = 0.0
    T_world_plane: Matrix4
    shade: Vector3

    def __post_init__(self) -> None:
        freeze_arrays(self)
        if abs(np.linalg.norm(self.direction) - 1) > 1e-6:
            raise ValueError("DirectionalLight.direction has not length 1")
        if not ((self.shade > 0) & (self.shade <= 1)).all():
            raise ValueError("DirectionalLight.shade is not in 0..1")

    @property
    def directions(self) -> Array:
        """Directions (K, 3) that together stand for the light."""
        return spread_directions(self.direction, self.width)

    @property
    def share(self) -> float:
        """What of the light on the surface is the lamp's, 0..1, linear."""
        return float(1 - np.mean(self.shade ** (1 / SRGB_POWER)))

    def factors(self, dark: Array) -> NDArray[np.float32]:
        """Factors (..., 3) on sRGB colors where a share (...,) of the light is taken."""
        return (1 - dark[..., None] * (1 - self.shade)).astype(np.float32)

    def shadow_seen(self, world: Gaussians, roles: NDArray[np.uint8], camera: Camera) -> tuple[Array, Array]:
        """How much of each pixel (H, W) is the surface, and how much of the light is taken there, 0..1.

        Args:
            world, roles: See `compute_directional_shadow`.
            camera: Where to look from.
        """
        still = (roles == SCENE).astype(np.float32)[:, None]
        drawn = render(world, camera, features=still, with_ids=True)
        depth = np.asarray(drawn.median_depth, np.float64)
        points, belongs = intersect_surface(self.T_world_plane, camera, depth)
        taken = compute_directional_shadow(world, roles, self.directions, points)
        return belongs * np.asarray(drawn.features)[..., 0], taken


@dataclass(frozen=True, slots=True, kw_only=True)
class Silhouette:
    """What a light sees of some bodies.

    Attributes:
        camera: At the light; None when there is nothing to see.
        alpha: (H, W), how much of its light is stopped.
    """

    camera: Camera | None
    alpha: NDArray[np.float32]

    def at(self, points_world: ArrayLike) -> Array:
        """Share (...,) of the light that does not reach points (..., 3) behind the bodies."""
        points = np.asarray(points_world, np.float64)
        if self.camera is None:
            return np.zeros(points.shape[:-1])
        pixels, _ = self.camera.project(points)
        # Order 1 with constant 0 outside; pixel centers lie at +0.5.
        return map_coordinates(self.alpha, [pixels[..., 1] - 0.5, pixels[..., 0] - 0.5], order=1)


def silhouette(bodies: Gaussians, direction: ArrayLike, parts: RigidParts | None = None) -> Silhouette:
    """Draw bodies as a light in a direction (3,) sees them; in the world frame, or in the frames of `parts`."""
    if not len(bodies):
        return Silhouette(camera=None, alpha=np.zeros((1, 1), np.float32))
    forward = -np.asarray(direction, np.float64)
    side = np.eye(3)[np.argmin(np.abs(forward))]
    right = np.cross(side, forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward], 1)
    means = np.asarray(bodies.means, np.float64)
    if parts is not None:
        Ts = parts.Ts_world_part[parts.indices]
        means = np.einsum("nij,nj->ni", Ts[:, :3, :3], means) + Ts[:, :3, 3]
    along = means @ R
    reach = 3 * float(bodies.scales.max(1).max())
    low, high = along[:, :2].min(0) - reach, along[:, :2].max(0) + reach
    cell = float((high - low).max()) / MAP_SIDE
    width, height = (int(n) + 2 for n in np.ceil((high - low) / cell))
    center = R @ np.append((low + high) / 2, along[:, 2].mean())
    camera = distant_camera(R, center, cell, (width, height))
    return Silhouette(camera=camera, alpha=render(bodies.with_sh_degree(0), camera, parts=parts).alpha)


def distant_camera(R_world_cam: Array, center: Array, cell: float, size: tuple[int, int]) -> Camera:
    """A camera so far from a center (3,) that its pixels show squares of a size `cell` there, [m]."""
    width, height = size
    return Camera(
        fx=FAR / cell, fy=FAR / cell, cx=width / 2, cy=height / 2, width=width, height=height,
        T_world_cam=transform(R_world_cam, center - FAR * R_world_cam[:, 2]),
    )  # fmt: skip


def spread_directions(direction: ArrayLike, width: float) -> Array:
    """Directions (K, 3) over a disc of half an angle `width` [rad] around one (3,): its middle and a ring."""
    middle = np.asarray(direction, np.float64)
    if not width:
        return middle[None]
    side = np.cross(middle, np.eye(3)[np.argmin(np.abs(middle))])
    side /= np.linalg.norm(side)
    turns = np.arange(RING) * 2 * np.pi / RING
    ring = np.stack([np.cos(turns), np.sin(turns)], 1) @ np.stack([side, np.cross(middle, side)])
    # Together with the middle the ring has the second moment of the disc.
    found = np.concatenate([middle[None], middle + np.tan(width) * np.sqrt((RING + 1) / (2 * RING)) * ring])
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def compute_directional_shadow(
    world: Gaussians, roles: NDArray[np.uint8], directions: Array, points: ArrayLike
) -> Array:
    """Share (...,) of a light from directions (K, 3) that moving bodies take from points (..., 3) below them.

    Where something that stands throws its shadow there is nothing left to take: `roles` (N,) tells what each of the
    world's Gaussians is, `SCENE`, `STANDS` or `MOVES`.
    """
    moving, stands = world.select(roles == MOVES), world.select(roles == STANDS)
    taken = [
        silhouette(moving, way).at(points) * (1 - silhouette(stands, way).at(points)) for way in directions
    ]
    return np.mean(taken, 0)


def intersect_surface(T_world_plane: Array, camera: Camera, depth: Array) -> tuple[Array, Array]:
    """Where lines of sight meet a plane (H, W, 3), and how much the depth seen (H, W) belongs to it, 0..1."""
    rays = camera.directions()
    to_plane = invert(T_world_plane)
    eye, falls = apply(to_plane, camera.center)[2], rays @ to_plane[2, :3]
    met = -eye / np.where(np.abs(falls) < 1e-9, 1e-9, falls)
    usable = (depth > 0) & (met > 0) & np.isfinite(met)
    belongs = surface_share(T_world_plane, camera.center + rays * depth[..., None]) * usable
    return camera.center + rays * np.where(usable, met, 0.0)[..., None], belongs


def surface_share(T_world_plane: Array, points_world: ArrayLike) -> Array:
    """How much points (..., 3) belong to a surface, 0..1, by their height over it."""
    heights = apply(invert(T_world_plane), points_world)[..., 2]
    return np.interp(heights, HEIGHTS, (0.0, 1.0, 1.0, 0.0))


def remove_shadow(gaussians: Gaussians, dark: Array, shade: Array) -> Gaussians:
    """Gaussians without a shadow that lies on them to some share `dark` (N,), 0..1."""
    return gaussians.brighten(1 / (1 - dark[:, None] * (1 - shade)))
