"""The scene's light, found on the robot: a surface whose shape and colors are known.

Each Gaussian of the robot shows the light that its surface direction receives, divided by the
color of the robot's model. Where too little of the robot was seen, the light falls from above
with the brightness of the scene.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.conventions import BACKGROUND, ROBOT, linear_from_srgb
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.light import COSINE_BANDS, Light, hemisphere_light
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.sh import sh_basis
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.splatting.surfaces import sphere_directions
from aomgen.twin.twin import Twin, body_poses, posed

# Robot surfaces darker than this say nothing about the light, linear.
MIN_ALBEDO: Final = 0.12
# Fewer Gaussians on the robot do not constrain the nine coefficients of the light.
MIN_SAMPLES: Final = 200
# A Gaussian farther than this from the posed meshes is not on their surface, [m].
MAX_DISTANCE: Final = 0.008
# Points drawn on each body of the robot.
POINTS_PER_BODY: Final = 3000
# Pull of bands 1 and 2 towards the light from above; band 0 is free.
PRIOR: Final = (0.02, 0.15)
# Mean albedo of things, to judge the brightness of light when the robot cannot.
MEAN_ALBEDO: Final = 0.4
# Brightness of a white, level surface stays within these limits, linear, 1 = image white.
LIMITS: Final = (0.3, 1.6)


class LightEstimate(NamedTuple):
    """A light, and where it comes from: "robot", or "scene" when too little of the robot was seen."""

    light: Light
    source: str


def estimate_light(twin: Twin, robot: RobotModel, rng: np.random.Generator) -> LightEstimate:
    """Find the light that the scan was taken under; `rng` chooses points on the robot.

    Not checked: the real robot may be painted otherwise than its model; a uniform difference
    enters the light's brightness, which is limited to `LIMITS`.
    """
    world = posed(twin, robot, twin.scan_state)
    fallback = scene_light(world, twin.labels)
    normals, albedo, seen = _robot_samples(twin, world, robot, rng)
    if not len(normals) >= MIN_SAMPLES:
        return LightEstimate(fallback, "scene")
    return LightEstimate(limit_light(fit_light(normals, albedo, seen, fallback)), "robot")


def scene_light(world: Gaussians, labels: NDArray[np.uint8]) -> Light:
    """Light from above whose brightness explains the scene's mean color with a mean albedo."""
    solid = (labels == BACKGROUND) & (world.opacities > 0.5)
    if not solid.any():
        return hemisphere_light(np.ones(3), np.full(3, 0.4))
    colors = linear_from_srgb(np.clip(0.5 + SH_C0 * world.sh[solid, 0], 0, 1))
    level = np.clip(np.median(colors, 0).mean() / MEAN_ALBEDO, *LIMITS)
    # A half sphere of radiance L lights a level surface with irradiance pi L.
    return hemisphere_light(np.full(3, level), np.full(3, 0.4 * level))


def fit_light(normals: Array, albedo: Array, seen: Array, prior: Light) -> Light:
    """Least squares of `seen = albedo * irradiance(normal) / pi` over nine coefficients.

    Linear colors (N, 3); bands 1 and 2 are pulled to those of a prior at the brightness found. No surface direction
    of the result is darker than a tenth of the mean.
    """
    basis = sh_basis(normals, 2) * (COSINE_BANDS / np.pi)
    brightness = float(
        np.median(seen.mean(1) / albedo.mean(1)) / max(np.median(prior.irradiance(normals)), 1e-6)
    )
    target = prior.radiance_sh * brightness
    pull = np.repeat([0.0, *PRIOR], [1, 3, 5])
    weights = np.ones(len(normals))
    coefficients = target
    for _ in range(5):
        columns = []
        for channel in range(3):
            A = basis * (albedo[:, channel] * np.sqrt(weights))[:, None]
            b = seen[:, channel] * np.sqrt(weights)
            ridge = np.diag(pull) * (A**2).sum() / 9
            columns.append(np.linalg.solve(A.T @ A + ridge, A.T @ b + ridge @ target[:, channel]))
        coefficients = np.stack(columns, 1)
        error = np.abs((albedo * (basis @ coefficients) - seen).mean(1))
        # Specular reflections and wrong links are outliers: Cauchy weights.
        weights = 1 / (1 + (error / max(2 * float(np.median(error)), 1e-6)) ** 2)
    return _positive(coefficients)


def limit_light(light: Light) -> Light:
    """The light with the brightness of a level white surface inside `LIMITS`."""
    level = float(light.irradiance(np.array([[0, 0, 1.0]])).mean())
    return light.scaled(np.clip(level, *LIMITS) / max(level, 1e-6))


def _positive(coefficients: Array) -> Light:
    """Bands 1 and 2 shrunk until no surface direction is darker than a tenth of the mean."""
    weighted = sh_basis(sphere_directions(200), 2) * COSINE_BANDS
    mean, rest = weighted[:, :1] @ coefficients[:1], weighted[:, 1:] @ coefficients[1:]
    share = min(1.0, float((0.9 * mean / np.maximum(-rest, 1e-9)).min()))
    return Light(radiance_sh=np.concatenate([coefficients[:1], coefficients[1:] * max(share, 0.0)]))


def _robot_samples(
    twin: Twin, world: Gaussians, robot: RobotModel, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Normals, model colors and seen colors of the robot's Gaussians that lie on its meshes."""
    Ts = body_poses(twin, robot, twin.scan_state)
    points, normals, colors = _surface_points(robot, Ts[1 : 1 + len(robot.body_names)], rng)
    mine = np.flatnonzero((twin.labels == ROBOT) & (world.opacities > 0.3) & (twin.bodies > 0))
    if not len(points):
        return points, normals, colors
    distances, nearest = cKDTree(points).query(world.means[mine])
    close = (distances < MAX_DISTANCE) & (colors[nearest].mean(1) > MIN_ALBEDO)
    mine, nearest = mine[close], nearest[close]
    seen = linear_from_srgb(np.clip(0.5 + SH_C0 * world.sh[mine, 0], 0, 1))
    return normals[nearest], colors[nearest], np.asarray(seen, np.float64)


def _surface_points(
    robot: RobotModel, Ts_world_body: Array, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    samples: list[Array] = [np.zeros((3, 0, 3))]
    for mesh in robot.meshes:
        vertices = apply(Ts_world_body[mesh.body], mesh.vertices_body)
        points, faces, _ = sample_surface(vertices, mesh.faces, POINTS_PER_BODY, rng)
        normals = face_normals_areas(vertices, mesh.faces)[0][faces]
        color = np.broadcast_to(linear_from_srgb(mesh.color_srgb), points.shape)
        samples.append(np.asarray([points, normals, color], np.float64))
    points, normals, colors = np.concatenate(samples, 1)
    return points, normals, colors
