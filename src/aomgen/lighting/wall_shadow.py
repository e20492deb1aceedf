"""Shadow of an object on the walls and objects around it; `plane_shadow` computes that on the surface below it.

The shadow is computed at a subset of the Gaussians and interpolated at the others.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.core.gaussians import Gaussians
from aomgen.core.light import DirectionalLight, Light
from aomgen.core.transforms import matrix_from_quat
from aomgen.core.values import Array
from aomgen.lighting.object_shadow import FILL
from aomgen.lighting.plane_shadow import surface_share
from aomgen.lighting.visibility import BODY_CELLS, Occluders, estimate_transfer, find_visibility

# Largest distance from the object at which its shadow is computed, [m]; beyond it, the shadow is weaker than image noise.
REACH_M: Final = 0.8
# Number of neighbors over which normals are averaged, because normals of single Gaussians are noisy.
NEIGHBORS: Final = 16
# Number of samples from which the shadow at a point is interpolated; standard deviation of their weights, [m]; and the weight
# of a shadow of 0, which dominates if no sample is near.
SAMPLES, SOFT_M, AWAY = 8, 0.03, 0.05
# Number of Gaussians of the object that represent its shape.
BODY_POINTS: Final = 20_000


def cast_wall_shadow(
    scene: Gaussians,
    body: Gaussians,
    light: Light,
    directional: DirectionalLight | None,
    eyes_world: Array,
    T_world_plane: Array,
    at_most: int,
) -> Array:
    """Compute the share (N, 1) of light that each Gaussian of a scene receives past an object.

    Args:
        scene: N static Gaussians, world frame.
        body: The object, world frame.
        light: All light at the object's location.
        directional: The directional light that is part of it, if any.
        eyes_world: Camera centers (K, 3), toward which the normals of surfaces are oriented.
        T_world_plane: Pose of the plane below the object (4, 4), on which the share is 1.
        at_most: Largest number of samples.
    """
    own, means = _thin(body.means.astype(np.float64), BODY_POINTS), scene.means.astype(np.float64)
    low, high = own.min(0), own.max(0)
    away = np.linalg.norm(np.maximum(np.maximum(low - means, means - high), 0), axis=1)
    wall = 1 - surface_share(T_world_plane, means)
    near = np.flatnonzero((away < REACH_M) & (wall > 0))
    received = np.ones((len(scene), 1))
    if not len(near):
        return received
    samples = _thin(near, at_most)
    points, normals = means[samples], _estimate_normals(scene.select(near), means[samples], eyes_world)
    occluders = Occluders(own, BODY_CELLS)
    rest, beams = (
        (light, []) if directional is None else (directional.split(light)[0], [directional.split(light)[1]])
    )
    arriving = estimate_transfer(points, normals, occluders)[0] @ rest.radiance_sh.mean(1)
    total = rest.irradiance(normals).mean(1)
    for beam in beams:
        visible = find_visibility(points, normals, occluders, beam.directions)
        arriving = np.maximum(arriving, 0) + beam.irradiance(normals, visible).mean(1)
        total = total + beam.irradiance(normals).mean(1)
    blocked = (1 - FILL) * (1 - np.clip(arriving / np.maximum(total, 1e-6), 0, 1))
    received[near, 0] -= wall[near] * _interpolate(points, blocked, means[near])
    return received


def _interpolate(samples: Array, values: Array, points: Array) -> Array:
    """Interpolate values of samples at points (N, 3) as a weighted mean, which is 0 far from all samples.

    Args:
        samples: Positions (M, 3), [m].
        values: Values (M,).
        points: Points (N, 3), [m].
    """
    count = min(SAMPLES, len(samples))
    distances, nearest = cKDTree(samples).query(points, count, distance_upper_bound=3 * SOFT_M)
    weights = np.exp(-0.5 * (distances / SOFT_M) ** 2).reshape(-1, count)
    found = np.append(values, 0.0)[nearest].reshape(-1, count)
    return (weights * found).sum(1) / (weights.sum(1) + AWAY)


def _thin(items: NDArray, count: int) -> NDArray:
    """Select at most `count` items at even spacing."""
    return items[:: -(-len(items) // count)]


def _estimate_normals(surface: Gaussians, points: Array, eyes_world: Array) -> Array:
    """Estimate the unit normals (N, 3) of a surface at points (N, 3), oriented toward the cameras."""
    _, around = cKDTree(surface.means).query(points, min(NEIGHBORS, len(surface)))
    axes = matrix_from_quat(surface.quats.astype(np.float64))
    normals = axes[np.arange(len(surface)), :, np.argmin(surface.scales, 1)]
    normals *= np.where(((eyes_world.mean(0) - surface.means) * normals).sum(1) < 0, -1, 1)[:, None]
    smooth = normals[np.reshape(around, (len(points), -1))].mean(1)
    return np.asarray(smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-9))
