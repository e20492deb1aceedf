"""Radiance that arrives at a point from all directions, rendered from the twin, and the covered share."""

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

# Number of pixels along the side of a face of the cube.
FACE_PX: Final = 24
# Directions with less accumulated alpha than this were not scanned.
MIN_ALPHA: Final = 0.05
# Camera axes (columns x, y, z) of the faces: along each axis of the world.
FACES: Final = tuple(
    np.stack([np.roll(z, 1), np.cross(z, np.roll(z, 1)), z], 1) for z in (*np.eye(3), *-np.eye(3))
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """Radiance at a location from D directions.

    Attributes:
        directions: Unit vectors towards the light, world frame.
        solid_angles: Solid angle of each direction, [sr]; 4 pi together.
        seen: Share of each direction that the scan shows, 0..1.
        radiance_linear: Radiance of that share, as images show it.
    """

    directions: Annotated[Array, "D 3"]
    solid_angles: Annotated[Array, "D"]
    seen: Annotated[Array, "D"]
    radiance_linear: Annotated[Array, "D 3"]

    __post_init__ = freeze_arrays

    def project(self, radiance: Array) -> Array:
        """Compute harmonics (9, ...) of radiance (D, ...)."""
        return project_radiance(self.directions, self.solid_angles, radiance)


def probe_light(world: Gaussians, place: Array, views: Sequence[Camera]) -> Probe:
    """Render Gaussians, world frame, outward from a location (3,).

    Directions outside all views of the scan count as unknown: distant Gaussians there explain other surfaces.
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
            # Solid angle of a pixel of the unit cube, by its distance and viewing angle.
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
    """Find points (N, 3) that are in the frame of one of the views; NaN are in none."""
    inside = np.zeros(len(points), bool)
    for view in views:
        pixels, depth = view.project(points)
        with np.errstate(invalid="ignore"):
            inside |= (depth > 0) & ((pixels >= 0) & (pixels < (view.width, view.height))).all(-1)
    return inside
