"""A camera for Gaussians of unknown content."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array
from aomgen.splatting.rasterizer import render

# Factor by which the camera approaches while its view is blocked.
STEP: Final = 0.8
# Largest number of such steps, to 7 % of the distance.
STEPS: Final = 12
# Width of the image in which that is judged, [px].
LOOK_WIDTH: Final = 64


def framing_camera(
    gaussians: Gaussians,
    size: tuple[int, int],
    *,
    up: ArrayLike = (0.0, -1.0, 0.0),
    angles_deg: tuple[float, float] = (30.0, 15.0),
    zoom: float = 1.0,
) -> Camera:
    """A camera that looks at the middle of the content and has it in view.

    An object is seen from outside as a whole. Where something large would hang before the camera
    (the walls of a room that was recorded from inside), the camera goes nearer until it sees past it.

    Args:
        gaussians: In any frame and unit.
        size: Width and height, [px].
        up: Direction (3,) that points up in the image; y points down in most 3DGS files.
        angles_deg: Azimuth around `up` and elevation above the horizon, [deg]; elevations are cut
            to +-89.
        zoom: Larger values go nearer.

    Raises:
        ValueError: Nothing visible, or a direction of length zero.
        BackendError: The engine is missing.
    """
    center, radius = content(gaussians)
    direction = _direction(np.asarray(up, np.float64), angles_deg)
    width, height = size
    focal_px = 1.2 * min(width, height)
    optics = Camera(
        fx=focal_px, fy=focal_px, cx=width / 2, cy=height / 2, width=width, height=height,
        T_world_cam=np.eye(4),
    )  # fmt: skip
    # The shorter side sees up to this angle from the axis; a little air is left around.
    half_angle = np.arctan(0.5 * min(width, height) / focal_px)
    distance = 1.05 * radius / np.sin(half_angle)
    for _ in range(STEPS):
        camera = optics.move(look_at(center + distance * direction, center, up))
        if not _is_view_blocked(gaussians, camera, distance):
            break
        distance *= STEP
    return optics.move(look_at(center + distance / zoom * direction, center, up))


def content(gaussians: Gaussians) -> tuple[Array, float]:
    """Middle (3,) and radius of what there is to see: almost all of an object, less of a wide scene.

    Gaussians count by their opacity, so that many small ones (detail) weigh more than a few large
    ones (walls, sky).

    Raises:
        ValueError: Nothing visible.
    """
    means, reach = gaussians.means.astype(np.float64), 2 * gaussians.scales.max(1).astype(np.float64)
    weights = gaussians.opacities.astype(np.float64)
    weights = np.where(np.isfinite(means).all(1) & np.isfinite(reach) & np.isfinite(weights), weights, 0)
    if not weights.sum() > 0:
        raise ValueError(f"none of {len(gaussians)} Gaussians is visible")
    ends = np.array([[_quantile(means[:, axis], weights, q) for axis in range(3)] for q in (0.1, 0.9)])
    center = ends.mean(0)
    distances = np.linalg.norm(means - center, axis=1) + reach
    return center, min(_quantile(distances, weights, 0.99), 2 * _quantile(distances, weights, 0.5))


def _is_view_blocked(gaussians: Gaussians, camera: Camera, distance: float) -> bool:
    """Return whether a fifth of the image shows content in the nearer half of the distance to the middle."""
    height = max(1, round(LOOK_WIDTH * camera.height / camera.width))
    drawn = render(gaussians, camera.resize(LOOK_WIDTH, height))
    return float(np.mean((drawn.alpha > 0.5) & (drawn.depth < 0.5 * distance))) > 0.2


def _quantile(values: Array, weights: Array, share: float) -> float:
    """Value below which a share of the weight lies."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, share * total[-1])])


def _direction(up: Array, angles_deg: tuple[float, float]) -> Array:
    """Unit vector at an azimuth around `up` and an elevation above its horizon."""
    length = np.linalg.norm(up)
    if not length > 0:
        raise ValueError("the up direction has length zero")
    up = up / length
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    azimuth, elevation = np.radians([angles_deg[0], np.clip(angles_deg[1], -89, 89)])
    level = np.cos(azimuth) * first + np.sin(azimuth) * np.cross(up, first)
    return np.cos(elevation) * level + np.sin(elevation) * up
