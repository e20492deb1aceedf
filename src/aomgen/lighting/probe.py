"""Radiance that arrives at a point from all directions, rendered from the Gaussians of a scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import linear_from_srgb
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.light import project_radiance
from aomgen.core.transforms import transform
from aomgen.core.values import Array, freeze_arrays
from aomgen.splatting.rasterizer import render
from aomgen.splatting.surfaces import compute_rendered_points

# Number of pixels along each side of a face of the cube map.
FACE_PX: Final = 24
# Directions with less accumulated alpha than this were not scanned.
MIN_ALPHA: Final = 0.05
# Camera orientations (columns are the axes x, y, z) of the six faces, which look along the axes of the world.
FACES: Final = tuple(
    np.stack([np.roll(z, 1), np.cross(z, np.roll(z, 1)), z], 1) for z in (*np.eye(3), *-np.eye(3))
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """Radiance at a location from D directions.

    Attributes:
        directions: Unit vectors (D, 3) toward the light, world frame.
        solid_angles: Solid angle of each direction (D,), [sr]; their sum is 4 pi.
        seen: Share of each direction that the scan covers (D,), 0..1.
        radiance_linear: Radiance of that share (D, 3), as the images show it.
    """

    directions: Annotated[Array, "D 3"]
    solid_angles: Annotated[Array, "D"]
    seen: Annotated[Array, "D"]
    radiance_linear: Annotated[Array, "D 3"]

    __post_init__ = freeze_arrays

    def project(self, radiance: Array) -> Array:
        """Compute the harmonics (9, ...) of radiance (D, ...)."""
        return project_radiance(self.directions, self.solid_angles, radiance)


def probe_light(world: Gaussians, place: Array, views: Sequence[Camera]) -> Probe:
    """Render the surroundings of a location as a cube map.

    Directions whose rendered points are outside the images of all views count as unknown, because distant Gaussians there do
    not represent observed surfaces.

    Args:
        world: Gaussians, world frame.
        place: Location (3,), world frame.
        views: Cameras of the scan.
    """
    found = []
    half = FACE_PX / 2
    for R in FACES:
        camera = Camera(
            fx=half, fy=half, cx=half, cy=half, width=FACE_PX, height=FACE_PX, T_world_cam=transform(R, place)
        )
        drawn, rays = render(world, camera, with_ids=True), camera.directions()
        length = np.linalg.norm(rays, axis=-1)
        shown = np.asarray(drawn.rgb, np.float64) / np.maximum(drawn.alpha, MIN_ALPHA)[..., None]
        known = (drawn.alpha > MIN_ALPHA).ravel() & _in_frame(
            compute_rendered_points(drawn, camera).reshape(-1, 3), views
        )
        found.append((
            (rays / length[..., None]).reshape(-1, 3),
            # This is the solid angle of a pixel of the cube with half side 1, from its distance and viewing angle.
            ((2 / FACE_PX) ** 2 / length**3).ravel(),
            np.where(known, drawn.alpha.ravel(), 0.0),
            linear_from_srgb(np.clip(shown, 0, 1)).reshape(-1, 3),
        ))  # fmt: skip
    directions, solid_angles, seen, radiance = (np.concatenate(part) for part in zip(*found, strict=True))
    return Probe(
        directions=directions,
        solid_angles=solid_angles * (4 * np.pi / solid_angles.sum()),
        seen=seen,
        radiance_linear=np.asarray(radiance, np.float64),
    )


def _in_frame(points: Array, views: Sequence[Camera]) -> NDArray[np.bool_]:
    """Return the mask (N,) of the points (N, 3) within the image of at least one view; NaN points are in none."""
    inside = np.zeros(len(points), bool)
    for view in views:
        pixels, depth = view.project(points)
        with np.errstate(invalid="ignore"):
            inside |= (depth > 0) & ((pixels >= 0) & (pixels < (view.width, view.height))).all(-1)
    return inside
