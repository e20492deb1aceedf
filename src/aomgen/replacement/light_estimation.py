"""The light where a new object is put: what the scan shows around that place, and what the robot tells of the rest.

Walls, table and things are seen, and so is what they send to the object. Lamps and windows mostly are not: a scan looks
down. The robot is a surface whose shape and colors are known; what it receives beyond what is seen from it comes from
there. Where too little of the robot was seen, the light falls from above with the brightness of the scene.
"""

from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from aomgen.conventions import BACKGROUND, ROBOT, linear_from_srgb, srgb_from_linear
from aomgen.core.environment_map import EnvironmentMap
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.light import Light, cosine_answer, hemisphere_light
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.sh import sh_basis
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.replacement.probe import Probe, probe_light
from aomgen.robots.robot import RobotModel
from aomgen.splatting.surfaces import sphere_directions
from aomgen.twin.twin import Twin, body_poses, posed

# Fewer Gaussians on the robot do not constrain the light; more than the second number tell no more.
MIN_SAMPLES, MAX_SAMPLES = 200, 3000
# A Gaussian farther than this from the posed meshes is not on their surface, [m].
MAX_DISTANCE: Final = 0.008
# Points drawn on each body of the robot.
POINTS_PER_BODY: Final = 3000
# A surface is seen by eyes above this sine of its plane; so many of all eyes must see it.
FACING, MIN_EYES = 0.2, 0.15
# Share of the light that paint and plastic reflect beside their own color: normal incidence, refractive index 1.5.
REFLECTED: Final = 0.04
# Errors of colors beyond this are outliers: glints, wrong links, sRGB.
OUTLIER: Final = 0.05
# Standard deviations of bands 1 and 2 of what is not seen, shares of its mean, and of the camera's loss of
# color; what share of all colors weighs as much as one of them.
BAND_SD, LOSS_SD, PRIOR_COLORS = (0.6, 0.4), 0.3, 1e-4
# The camera's loss of color stays between these.
LOSSES: Final = (0.0, 0.8)
# Nearly black surfaces show reflections rather than light, linear.
MIN_ALBEDO: Final = 0.05
# Directions in which a light is checked.
NORMALS: Final = 200
# Mean albedo of things, to judge the brightness of light when the robot cannot.
MEAN_ALBEDO: Final = 0.4
# Brightness of a white, level surface stays within these limits, linear, 1 = image white.
LIMITS: Final = (0.3, 1.6)


class SceneLight(NamedTuple):
    """What a new object is lit by, and how the scene's pictures show colors.

    Attributes:
        light: Where the object stands, in the colors in which pictures show it on a grey surface.
        color_loss: Share of a color's distance from grey that the camera's tone curve takes, 0..1.
        source: "robot", or "scene" when too little of the robot was seen, or "file" or "diffusion" of a map.
    """

    light: Light
    color_loss: float
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LitSamples:
    """N places of the robot's surface: unit normals, colors of the model and colors seen, linear."""

    normals: Annotated[Array, "N 3"]
    albedo: Annotated[Array, "N 3"]
    seen: Annotated[Array, "N 3"]

    __post_init__ = freeze_arrays

    def select(self, which: NDArray) -> "LitSamples":
        """Some of them."""
        return LitSamples(normals=self.normals[which], albedo=self.albedo[which], seen=self.seen[which])


def lose_color(colors_linear: Array, loss: float) -> Array:
    """Colors (..., 3) drawn to their grey by a share; a negative share takes them away from it."""
    grey = colors_linear.mean(-1, keepdims=True)
    return grey + (1 - loss) * (colors_linear - grey)


def estimate_light(
    twin: Twin,
    robot: RobotModel,
    around: Gaussians,
    place: Array,
    eyes_world: Array,
    rng: np.random.Generator,
) -> SceneLight:
    """Find the light that the scan was taken under.

    Args:
        twin: Recorded scene.
        robot: Its robot.
        around: What stands still about the object, in its shadow too, world frame.
        place: Where the light is wanted (3,), world frame.
        eyes_world: Where the scan's cameras were (K, 3).
        rng: Chooses points on the robot.

    Not checked: the real robot may be painted otherwise than its model; a uniform difference
    enters the light's brightness, which is limited to `LIMITS`.
    """
    world = posed(twin, robot, twin.scan_state)
    of_robot = (twin.labels == ROBOT) & (twin.bodies > 0)
    samples = _robot_samples(twin, world, robot, eyes_world, rng)
    if not len(samples.normals) >= MIN_SAMPLES:
        return SceneLight(scene_light(world, twin.labels), 0.0, "scene")
    middle = np.median(world.means[of_robot], 0).astype(np.float64)
    unseen, loss = fit_unseen(samples, probe_light(world.select(twin.labels != ROBOT), middle))
    radiance = lose_color(radiance_around(probe_light(around, place), unseen, loss), loss)
    return SceneLight(limit_light(_positive(radiance)), loss, "robot")


def scene_light(world: Gaussians, labels: NDArray[np.uint8]) -> Light:
    """Light from above whose brightness explains the scene's mean color with a mean albedo."""
    solid = (labels == BACKGROUND) & (world.opacities > 0.5)
    if not solid.any():
        return hemisphere_light(np.ones(3), np.full(3, 0.4))
    colors = linear_from_srgb(np.clip(0.5 + SH_C0 * world.sh[solid, 0], 0, 1))
    level = np.clip(np.median(colors, 0).mean() / MEAN_ALBEDO, *LIMITS)
    # A half sphere of radiance L lights a level surface with irradiance pi L.
    return hemisphere_light(np.full(3, level), np.full(3, 0.4 * level))


def fit_unseen(samples: LitSamples, around: Probe) -> tuple[Array, float]:
    """What comes to the robot from where the scan shows nothing, as harmonics (9, 3), and the camera's loss of color.

    Args:
        samples: On the robot.
        around: What is seen from its middle.
    """
    answer, wanted = cosine_answer(samples.normals), srgb_from_linear(np.clip(samples.seen, 0, 1))
    spreads = np.repeat(BAND_SD, [3, 5])[:, None]
    weight = np.sqrt(PRIOR_COLORS * len(wanted))

    def residuals(unknown: Array) -> Array:
        unseen, loss = unknown[:27].reshape(9, 3), float(unknown[27])
        irradiance = np.maximum(answer @ radiance_around(around, unseen, loss), 0)
        sent = lose_color((samples.albedo + REFLECTED) * irradiance, loss)
        level = max(float(np.abs(unseen[0]).mean()), 1e-3)
        prior = np.append(unseen[1:] / (level * spreads), loss / LOSS_SD)
        return np.append((srgb_from_linear(np.maximum(sent, 1e-6)) - wanted).ravel(), weight * prior)

    start = np.concatenate([np.ones(3), np.zeros(24), [0.1]])
    low, high = (
        np.append(np.full(27, end), limit) for end, limit in zip((-np.inf, np.inf), LOSSES, strict=True)
    )
    found = least_squares(residuals, start, bounds=(low, high), loss="soft_l1", f_scale=OUTLIER).x
    return found[:27].reshape(9, 3), float(found[27])


def radiance_around(around: Probe, unseen: Array, loss: float) -> Array:
    """Harmonics (9, 3) of all that arrives at a probe: what it sees, in the colors before the camera, and the rest."""
    shown = np.maximum(lose_color(around.radiance_linear, -loss / (1 - loss)), 0)
    rest = np.maximum(sh_basis(around.directions, 2) @ unseen, 0)
    return around.project(around.seen[:, None] * shown + (1 - around.seen[:, None]) * rest)


def limit_light(light: Light) -> Light:
    """The light with the brightness of a level white surface inside `LIMITS`."""
    level = _level(light)
    return light.scaled(np.clip(level, *LIMITS) / max(level, 1e-6))


def light_of_map(around: EnvironmentMap, scan: SceneLight, source: str) -> SceneLight:
    """The light of a map, as bright on a level surface and with as much color lost as the light found in a scan."""
    light = _positive(lose_color(around.light().radiance_sh, scan.color_loss))
    return SceneLight(light.scaled(_level(scan.light) / _level(light)), scan.color_loss, source)


def _level(light: Light) -> float:
    """Brightness of a level white surface, linear, mean of the channels."""
    return float(light.irradiance(np.array([[0, 0, 1.0]])).mean())


def _positive(coefficients: Array) -> Light:
    """Bands 1 and 2 shrunk until no surface direction is darker than a tenth of the mean."""
    weighted = cosine_answer(sphere_directions(NORMALS))
    mean, rest = weighted[:, :1] @ coefficients[:1], weighted[:, 1:] @ coefficients[1:]
    share = min(1.0, float((0.9 * mean / np.maximum(-rest, 1e-9)).min()))
    return Light(radiance_sh=np.concatenate([coefficients[:1], coefficients[1:] * max(share, 0.0)]))


def _robot_samples(
    twin: Twin, world: Gaussians, robot: RobotModel, eyes_world: Array, rng: np.random.Generator
) -> LitSamples:
    """The robot's Gaussians that lie on its meshes and were seen from several sides."""
    Ts = body_poses(twin, robot, twin.scan_state)
    points, normals, colors = _surface_points(robot, Ts[1 : 1 + len(robot.body_names)], rng)
    mine = np.flatnonzero((twin.labels == ROBOT) & (world.opacities > 0.3) & (twin.bodies > 0))
    if not len(points):
        return LitSamples(normals=points, albedo=colors, seen=colors)
    distances, nearest = cKDTree(points).query(world.means[mine])
    close = (distances < MAX_DISTANCE) & (colors[nearest].mean(1) > MIN_ALBEDO)
    mine, nearest = mine[close], nearest[close]
    if len(mine) > MAX_SAMPLES:
        chosen = rng.choice(len(mine), MAX_SAMPLES, replace=False)
        mine, nearest = mine[chosen], nearest[chosen]
    ways = eyes_world - points[nearest][:, None]
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    facing = np.einsum("nki,ni->nk", ways, normals[nearest]) > FACING
    seen = linear_from_srgb(np.clip(0.5 + SH_C0 * world.sh[mine, 0], 0, 1))
    found = LitSamples(normals=normals[nearest], albedo=colors[nearest], seen=np.asarray(seen, np.float64))
    return found.select(facing.mean(1) > MIN_EYES)


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
