"""Cameras that circle a scene as those of its scan did."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera, look_at
from aomgen.core.values import Array

# A gap between the directions of the scan's cameras that is wider is not crossed, [rad].
MAX_GAP_RAD: Final = np.pi / 2
# Share of the outermost cameras on either side that the path does not reach: views there are extrapolated.
MARGIN: Final = 0.05


def plan_turntable(cameras: list[Camera], frames: int) -> list[Camera]:
    """Plan a closed path around what the cameras of a scan look at.

    A scan from all sides gives a circle, any other a swing between its ends; distance and height are the cameras'
    median.

    Args:
        cameras: At least two, upright on average.
        frames: Number of cameras of the path.

    Returns:
        Cameras with the optics of the first one, in the same frame.
    """
    ups = -np.array([camera.T_world_cam[:3, 1] for camera in cameras])
    up = _normalize(ups.mean(0))
    target = find_target(cameras)
    right = _normalize(np.cross(cameras[0].T_world_cam[:3, 2], up))
    forward = np.cross(up, right)
    offsets = np.array([camera.center for camera in cameras]) - target
    heights, x, y = offsets @ up, offsets @ right, offsets @ forward
    radius, height = float(np.median(np.hypot(x, y))), float(np.median(heights))
    angles = _spread_angles(np.arctan2(y, x), frames)
    eyes = (
        target + radius * (np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * forward) + height * up
    )
    return [cameras[0].move(look_at(eye, target, up)) for eye in eyes]


def find_target(cameras: list[Camera]) -> Array:
    """Return the point (3,) nearest to all optical axes, world frame."""
    axes = np.array([camera.T_world_cam[:3, 2] for camera in cameras])
    centers = np.array([camera.center for camera in cameras])
    projections = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # Axes that are nearly parallel determine a point at any distance; the smallest shift is taken.
    middle = centers.mean(0)
    return (
        middle
        + np.linalg.lstsq(
            projections.sum(0), np.einsum("nij,nj->i", projections, centers - middle), rcond=1e-6
        )[0]
    )


def _spread_angles(taken: Array, frames: int) -> Array:
    """Angles of a closed path, [rad]: once around, or there and back between the ends of `taken`."""
    ordered = np.sort(taken)
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * np.pi))
    shares = np.arange(frames) / frames
    if gaps.max() <= MAX_GAP_RAD:
        return 2 * np.pi * shares
    first = int(np.argmax(gaps)) + 1
    unwrapped = np.sort((taken - ordered[first % len(ordered)]) % (2 * np.pi))
    low, high = np.quantile(unwrapped, [MARGIN, 1 - MARGIN]) + ordered[first % len(ordered)]
    return low + (high - low) * 0.5 * (1 - np.cos(2 * np.pi * shares))


def _normalize(vector: NDArray[np.floating]) -> Array:
    return np.asarray(vector / np.linalg.norm(vector), np.float64)
