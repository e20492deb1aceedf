"""One strong light far away, and the shadow that moving bodies throw on the surface they work over.

Whether a point is in shadow is read off an image of the bodies taken from the light (shadow
mapping: Williams 1978, "Casting curved shadows on curved surfaces").
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from aomgen.core.camera import Camera
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.transforms import apply, invert, transform
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays
from aomgen.splatting.rasterizer import Rendering, RigidParts, render

# Distance of the camera that stands for the light: its image is an orthographic one, [m].
FAR: Final = 60.0
# Longer side of the image from the light, [px]: a few millimeters each for an arm's shadow.
MAP_SIDE: Final = 384
# Heights over which a seen point fades in and out of the surface, [m]. Depth of trained
# surfaces is uncertain, mostly downwards, because lower Gaussians shine through.
HEIGHTS: Final = (-0.09, -0.06, 0.012, 0.03)
# The role of Gaussians for shadows.
SCENE: Final = 0  # what shadows fall on
STANDS: Final = 1  # throws a shadow that is always the same
MOVES: Final = 2  # throws a shadow that comes and goes


@dataclass(frozen=True, slots=True, kw_only=True)
class DirectionalLight:
    """A light that throws crisp shadows on a level surface.

    Attributes:
        direction: Unit (3,), from the scene to the light, world frame.
        T_world_plane: The surface (4, 4), z = 0 on it.
        shade: Color in shadow divided by color in light (3,), sRGB, 0..1.
    """

    direction: Vector3
    T_world_plane: Matrix4
    shade: Vector3

    def __post_init__(self) -> None:
        freeze_arrays(self)
        if abs(np.linalg.norm(self.direction) - 1) > 1e-6:
            raise ValueError("DirectionalLight.direction has not length 1")
        if not ((self.shade > 0) & (self.shade <= 1)).all():
            raise ValueError("DirectionalLight.shade is not in 0..1")


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
    """Draw bodies as a light in a direction (3,) sees them.

    Args:
        bodies: N, world frame, or in the frames of `parts`.
        direction: To the light.
        parts: Where the parts are.
    """
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
    across = means @ R[:, :2]
    reach = 3 * float(bodies.scales.max(1).max())
    low, high = across.min(0) - reach, across.max(0) + reach
    cell = float((high - low).max()) / MAP_SIDE
    width, height = (int(n) + 2 for n in np.ceil((high - low) / cell))
    center = R[:, :2] @ ((low + high) / 2) + forward * (float((means @ forward).mean()) - FAR)
    camera = Camera(
        fx=FAR / cell, fy=FAR / cell, cx=width / 2, cy=height / 2, width=width, height=height,
        T_world_cam=transform(R, center),
    )  # fmt: skip
    return Silhouette(camera=camera, alpha=render(bodies.with_sh_degree(0), camera, parts=parts).alpha)


def cast_directional_shadow(
    world: Gaussians, roles: NDArray[np.uint8], direction: ArrayLike, points: ArrayLike
) -> Array:
    """Share (...,) of a light that moving bodies take from points (..., 3) of a surface below them.

    Args:
        world: All Gaussians (N), world frame.
        roles: `SCENE`, `STANDS` or `MOVES` for each (N,). Where something that stands throws its
            shadow there is nothing left to take.
        direction: To the light (3,).
        points: World frame.
    """
    taken = silhouette(world.select(roles == MOVES), direction).at(points)
    return taken * (1 - silhouette(world.select(roles == STANDS), direction).at(points))


def draw_lit(
    light: DirectionalLight, world: Gaussians, roles: NDArray[np.uint8], camera: Camera, **options: Any
) -> tuple[Rendering, Array, Array]:
    """Draw Gaussians, and by what factor the shadow of moving bodies darkens each pixel.

    Args:
        light: What shines.
        world, roles: See `cast_directional_shadow`.
        camera: Where to look from.
        options: For `splatting.rasterizer.render`.

    Returns:
        The image without shadow; how much of each pixel is the surface (H, W), 0..1; and how much of
        the light is taken there (H, W), 0..1. See `compute_shadow_factors`.
    """
    own = np.asarray(options.pop("features", np.zeros((len(world), 0))), np.float32)
    still = (roles == SCENE).astype(np.float32)[:, None]
    wanted = options.pop("with_ids", False)
    drawn = render(world, camera, features=np.concatenate([own, still], 1), with_ids=True, **options)
    images = np.asarray(drawn.features)
    depth = np.asarray(drawn.median_depth, np.float64)
    points, on_plane = intersect_surface(light.T_world_plane, camera, depth)
    taken = cast_directional_shadow(world, roles, light.direction, points)
    picture = Rendering(
        rgb=drawn.rgb,
        alpha=drawn.alpha,
        depth=drawn.depth,
        median_depth=drawn.median_depth if wanted else None,
        max_id=drawn.max_id if wanted else None,
        features=images[..., :-1] if own.shape[1] else None,
    )
    return picture, on_plane * images[..., -1], taken


def compute_shadow_factors(light: DirectionalLight, dark: Array) -> NDArray[np.float32]:
    """Factors (..., 3) on sRGB colors where a share (...,) of the light is taken."""
    return (1 - dark[..., None] * (1 - light.shade)).astype(np.float32)


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
    factor = 1 / (1 - dark[:, None] * (1 - shade))
    sh = gaussians.sh * factor[:, None]
    sh[:, 0] = ((0.5 + SH_C0 * gaussians.sh[:, 0]) * factor - 0.5) / SH_C0
    return gaussians.with_sh(sh)
