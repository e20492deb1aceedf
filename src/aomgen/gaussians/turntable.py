"""Cameras that circle a scene as those of its scan did."""

from typing import Final

import numpy as np

from aomgen.core.camera import Camera, look_at
from aomgen.core.values import Array
from aomgen.core.walk import Walk, describe_walk

# Largest gap between the directions of the scan's cameras that the path crosses, [rad].
MAX_GAP_RAD: Final = np.pi / 2
# Share of the outermost cameras on either side beyond the ends of the path, because views there are extrapolated.
MARGIN: Final = 0.05


def plan_turntable(cameras: list[Camera], frames: int) -> list[Camera]:
    """Plan a closed path around the point at which the cameras of a scan look.

    The path is a circle for a scan from all sides, and otherwise moves back and forth between the ends of the scan. Distance and
    height are the median of the cameras.

    Args:
        cameras: At least two, upright on average.
        frames: Number of cameras of the path.

    Returns:
        Cameras with the optics of the first one, in the same frame.
    """
    walk = describe_walk([camera.T_world_cam for camera in cameras])
    x, y, heights = walk.positions.T
    radius = float(np.median(np.hypot(x, y)))
    angles = _spread_angles(walk, frames)
    path = np.stack(
        [radius * np.cos(angles), radius * np.sin(angles), np.full(frames, np.median(heights))], 1
    )
    eyes = walk.target + path @ walk.axes
    return [cameras[0].move(look_at(eye, walk.target, walk.axes[2])) for eye in eyes]


def _spread_angles(walk: Walk, frames: int) -> Array:
    """Compute the angles of a closed path, [rad]: one revolution, or back and forth between the ends of the walk."""
    shares = np.arange(frames) / frames
    gap_rad, _, first = walk.find_gap()
    if gap_rad <= MAX_GAP_RAD:
        return 2 * np.pi * shares
    start = walk.azimuths[first]
    low, high = np.quantile((walk.azimuths - start) % (2 * np.pi), [MARGIN, 1 - MARGIN]) + start
    return low + (high - low) * 0.5 * (1 - np.cos(2 * np.pi * shares))
