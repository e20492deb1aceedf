"""Estimate environment light from images of a mirror ball.

Source: Debevec 1998 (mirror balls); Debevec & Malik 1997 (images of several exposures).
"""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from aomgen.conventions import linear_from_srgb
from aomgen.core.camera import Camera
from aomgen.core.environment_map import EnvironmentMap, map_directions
from aomgen.core.values import Array

# Range of the sRGB value of a pixel's brightest channel over which the pixel is increasingly treated as clipped.
CLIPPED: Final = (0.8, 0.95)
# Number of rows of the map; the ball in a typical image is 256 pixels wide.
ROWS: Final = 256


def merge_exposures(pictures_srgb: ArrayLike, exposures: ArrayLike) -> Array:
    """Merge images of one view to linear radiance (H, W, 3).

    Args:
        pictures_srgb: Images (E, H, W, 3), 0..1, in the order of decreasing exposure.
        exposures: Exposure of each image (E,), in stops; at 0, radiance 1 is white.
    """
    pictures = np.asarray(pictures_srgb, np.float64)
    radiance = linear_from_srgb(pictures) / 2.0 ** np.reshape(exposures, (-1, 1, 1, 1))
    low, high = CLIPPED
    merged = radiance[-1]
    for picture, own in zip(pictures[-2::-1], radiance[-2::-1], strict=True):
        clipped = np.clip((picture.max(-1, keepdims=True) - low) / (high - low), 0, 1)
        merged = (1 - clipped) * own + clipped * merged
    return merged


def compute_reflected_directions(camera: Camera) -> tuple[NDArray[np.bool_], Array]:
    """Compute the directions that a mirror ball reflects; the ball touches the borders of a square image.

    Returns:
        Mask (H, W) of the N pixels of the ball, and for each of them the unit direction (N, 3), world frame, from which its
        light arrives.
    """
    side, half = camera.width, camera.width // 2
    rays = camera.directions()
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    edges = np.stack([rays[half, 0], rays[half, side - 1], rays[0, half], rays[side - 1, half]])
    middle = edges.mean(0) / np.linalg.norm(edges.mean(0))
    # The distance of the ball's center is set to 1, so that its radius is the sine of half its viewing angle.
    cosine = float((edges @ middle).mean())
    radius, along = np.sqrt(1 - cosine**2), rays @ middle
    inside = along > cosine
    views, along = rays[inside], along[inside][:, None]
    hits = (along - np.sqrt(along**2 - cosine**2)) * views
    normals = (hits - middle) / radius
    return inside, views - 2 * np.einsum("ni,ni->n", views, normals)[:, None] * normals


def unwrap_ball(radiance_linear: Array, camera: Camera) -> EnvironmentMap:
    """Compute the light around a mirror ball from its reflections in a square image (S, S, 3), whose borders it touches.

    Directions behind the ball are not reflected and are filled from pixels near its outline.
    """
    inside, directions = compute_reflected_directions(camera)
    wanted = map_directions(ROWS, 2 * ROWS)
    nearest = cKDTree(directions).query(wanted.reshape(-1, 3))[1]
    radiance = radiance_linear[inside][nearest].reshape(wanted.shape)
    return EnvironmentMap(radiance_linear=radiance.astype(np.float32))
