"""How much light an object keeps from walls and things around it; `plane_shadow` has the table.

Some of their Gaussians tell it, each by the share of the sphere that the object covers before it.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.conventions import SRGB_POWER
from aomgen.core.gaussians import Gaussians
from aomgen.core.light import Light
from aomgen.core.transforms import matrix_from_quat
from aomgen.core.values import Array
from aomgen.splatting.surfaces import open_past, transfer_past
from aomgen.twin.plane_shadow import FILL
from aomgen.twin.shadow import DirectionalLight, surface_share

# Farther from the object its shadow is weaker than a picture's noise, [m].
REACH_M: Final = 0.8
# Neighbours over which normals are averaged: those of single Gaussians are rough.
NEIGHBORS: Final = 16
# So many places tell it at a point; over so much it is smooth, [m]; and what they weigh where there is none.
PLACES, SOFT_M, AWAY = 8, 0.03, 0.05
# Of an object's Gaussians so many tell its shape.
BODY_POINTS: Final = 20_000


class ThingShadow(NamedTuple):
    """Places (N, 3) of walls and things near an object, and the share (N,) of their light that it lets through."""

    points: Array
    passed: NDArray[np.float32]

    def at(self, points_world: Array) -> NDArray[np.float32]:
        """Share (N,) at points (N, 3): the mean of places near by, and all of it away from them."""
        if not len(self.points):
            return np.ones(len(points_world), np.float32)
        near = min(PLACES, len(self.points))
        distances, places = cKDTree(self.points).query(points_world, near, distance_upper_bound=3 * SOFT_M)
        weights = np.exp(-0.5 * (distances / SOFT_M) ** 2).reshape(-1, near)
        taken = np.append(1 - self.passed, np.float32(0))[places].reshape(-1, near)
        return 1 - ((weights * taken).sum(1) / (weights.sum(1) + AWAY)).astype(np.float32)

    def factors(self, gaussians: Gaussians, T_world_plane: Array) -> Array:
        """Factors (N, 1) on sRGB colors of a scene's Gaussians but those on a plane, world frame."""
        means = gaussians.means.astype(np.float64)
        return (self.at(means) ** (SRGB_POWER * (1 - surface_share(T_world_plane, means))))[:, None]


def compute_surrounding_shadow(
    scene: Gaussians,
    body: Gaussians,
    light: Light,
    lamp: DirectionalLight | None,
    eyes_world: Array,
    T_world_plane: Array,
    at_most: int,
) -> ThingShadow:
    """The shadow of a body on what stands around it.

    Args:
        scene: All that never moves, world frame.
        body: The object, world frame.
        light: At its place.
        lamp: What of it comes from one side.
        eyes_world: Where cameras are (K, 3): surfaces look to them.
        T_world_plane: The table, which is left out.
        at_most: Places that are computed.
    """
    own = _some(body.means.astype(np.float64), BODY_POINTS)
    low, high = own.min(0), own.max(0)
    means = scene.means.astype(np.float64)
    away = np.linalg.norm(np.maximum(np.maximum(low - means, means - high), 0), axis=1)
    things = np.flatnonzero((away < REACH_M) & (surface_share(T_world_plane, means) < 1))
    if not len(things):
        return ThingShadow(np.zeros((0, 3)), np.zeros(0, np.float32))
    chosen = _some(things, at_most)
    points, normals = means[chosen], _normals(scene.select(things), means[chosen], eyes_world)
    rest, lamp_open, lamp_passed = light, np.zeros(len(points)), np.zeros(len(points))
    if lamp is not None:
        up = lamp.T_world_plane[:3, 2]
        rest = light.without(lamp.direction, up, lamp.share)
        level = lamp.share * float(light.irradiance(up[None]).mean()) / float(lamp.direction @ up)
        lamp_open = level * np.maximum(normals @ lamp.direction, 0)
        lamp_passed = lamp_open * open_past(points, lamp.directions, own)
    passed = np.maximum(transfer_past(points, normals, own) @ rest.radiance_sh.mean(1), 0) + lamp_passed
    without = rest.irradiance(normals).mean(1) + lamp_open
    share = np.clip(passed / np.maximum(without, 1e-6), 0, 1)
    return ThingShadow(points, (FILL + (1 - FILL) * share).astype(np.float32))


def _some(items: NDArray, count: int) -> NDArray:
    """At most `count` of the items, evenly."""
    return items[:: -(-len(items) // count)]


def _normals(surface: Gaussians, points: Array, eyes_world: Array) -> Array:
    """Unit normals (N, 3) of a surface at points (N, 3), towards the eyes."""
    _, around = cKDTree(surface.means).query(points, min(NEIGHBORS, len(surface)))
    axes = matrix_from_quat(surface.quats.astype(np.float64))
    normals = axes[np.arange(len(surface)), :, np.argmin(surface.scales, 1)]
    normals *= np.where(((eyes_world.mean(0) - surface.means) * normals).sum(1) < 0, -1, 1)[:, None]
    smooth = normals[np.reshape(around, (len(points), -1))].mean(1)
    return np.asarray(smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-9))
