"""Automatic choice of a camera for Gaussians of unknown content."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import make_tangent_basis
from aomgen.core.values import Array
from aomgen.splatting.rasterizer import render

# Factor on the camera's distance in each step towards the content while the view is blocked.
STEP: Final = 0.8
# Largest number of such steps; together they reduce the distance to 7 %.
STEPS: Final = 12
# Width of the image that is tested for blockage, [px].
LOOK_WIDTH: Final = 64


def framing_camera(
    gaussians: Gaussians,
    size: tuple[int, int],
    *,
    up: ArrayLike = (0.0, -1.0, 0.0),
    angles_deg: tuple[float, float] = (30.0, 15.0),
    zoom: float = 1.0,
) -> Camera:
    """Choose a camera that is directed at the center of the content and shows it.

    An object is shown completely from outside. If large surfaces between camera and center block the view (for example
    the walls of a room that was recorded from inside), the camera moves closer until they are behind it.

    Args:
        gaussians: Gaussians in any frame and length unit.
        size: Width and height of the image, [px].
        up: Direction (3,) that points up in the image; the default suits most 3DGS files, whose y axis points down.
        angles_deg: Azimuth around `up` and elevation above the horizon, [deg]; elevations are clipped to +-89.
        zoom: Factor by which the distance to the center is divided.

    Returns:
        Camera in the frame of the Gaussians.

    Raises:
        ValueError: No Gaussian is visible, or `up` has length zero.
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
    # Half of the field of view along the shorter side; the factor 1.05 below leaves a margin.
    half_angle = np.arctan(0.5 * min(width, height) / focal_px)
    distance = 1.05 * radius / np.sin(half_angle)
    for _ in range(STEPS):
        camera = optics.move(look_at(center + distance * direction, center, up))
        if not _is_view_blocked(gaussians, camera, distance):
            break
        distance *= STEP
    return optics.move(look_at(center + distance / zoom * direction, center, up))


def content(gaussians: Gaussians) -> tuple[Array, float]:
    """Compute the center (3,) and the radius of the visible content, in the frame and unit of the Gaussians.

    The sphere contains almost all of an object, but only the central part of an extended scene. Gaussians are weighted by
    their opacity, so that regions of many small Gaussians (detail) count more than a few large ones (walls, sky).

    Raises:
        ValueError: No Gaussian is visible.
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
    """Return whether more than a fifth of the image shows content nearer than half of the distance to the center."""
    height = max(1, round(LOOK_WIDTH * camera.height / camera.width))
    drawn = render(gaussians, camera.resize(LOOK_WIDTH, height))
    return float(np.mean((drawn.alpha > 0.5) & (drawn.depth < 0.5 * distance))) > 0.2


def _quantile(values: Array, weights: Array, share: float) -> float:
    """Compute the value below which a share of the total weight lies."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, share * total[-1])])


def _direction(up: Array, angles_deg: tuple[float, float]) -> Array:
    """Compute the unit vector at an azimuth around `up` and an elevation above the horizon."""
    length = np.linalg.norm(up)
    if not length > 0:
        raise ValueError("the up direction has length zero")
    up = up / length
    first, second = make_tangent_basis(up)
    azimuth, elevation = np.radians([angles_deg[0], np.clip(angles_deg[1], -89, 89)])
    level = np.cos(azimuth) * first + np.sin(azimuth) * second
    return np.cos(elevation) * level + np.sin(elevation) * up
