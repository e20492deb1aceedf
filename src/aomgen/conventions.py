"""Conventions of frames, units and axis orders of the whole package, and conversions from and to other conventions.

The world frame is the robot's base frame with Z up. Units are meters, radians and seconds. A pose is `T_<to>_<from>`
(4, 4): `p_world = T_world_cam @ p_cam`. `S_` is a similarity, `R_` a rotation. Camera axes are those of OpenCV (x right,
y down, z forward), pixel centers are at +0.5, and quaternions are in the order w, x, y, z with the real part w.
"""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Part labels of Gaussians, masks and label images.
BACKGROUND: Final = 0  # all other surfaces
ROBOT: Final = 1  # arm and gripper
STATIC: Final = 2  # body of the object
MOVING: Final = 3  # door, drawer or lid of the object
PART_LABELS: Final = {"background": BACKGROUND, "robot": ROBOT, "static": STATIC, "moving": MOVING}


def xyzw_from_wxyz(quats_wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert quaternions (..., 4) to the order x, y, z, w of scipy and ROS."""
    return np.roll(quats_wxyz, -1, axis=-1)


def linear_from_srgb(srgb: NDArray[np.floating]) -> NDArray[np.floating]:
    """Convert sRGB values in 0..1 to linear radiance. Source: IEC 61966-2-1."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0) + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: NDArray[np.floating]) -> NDArray[np.floating]:
    """Convert linear radiance to sRGB values, both in 0..1. Source: IEC 61966-2-1."""
    clipped = np.maximum(linear, 0)
    return np.where(clipped <= 0.0031308, clipped * 12.92, 1.055 * clipped ** (1 / 2.4) - 0.055)


def illuminate_srgb(srgb: NDArray[np.floating], factors: ArrayLike) -> NDArray[np.floating]:
    """Multiply the light on surfaces with given sRGB values by factors; the results are >= 0 and not limited to 1."""
    return srgb_from_linear(linear_from_srgb(srgb) * np.asarray(factors))


def luma_from_srgb(srgb: NDArray) -> NDArray[np.float32]:
    """Compute the luma (...,), 0..1, of sRGB values (..., 3) in 0..255. Source: Rec. 601."""
    return np.asarray(srgb, np.float32) @ np.array([0.299, 0.587, 0.114], np.float32) / np.float32(255)
