"""Estimate the light at the location of a new object from the scan and from the shading of the robot.

The scan shows walls, table and clutter, and therefore the light that they reflect to the object. It mostly does not show
light sources, because its cameras point downward. The robot has a known shape and color; light on it that the visible
surroundings do not explain arrives from unobserved directions. If too little of the robot is visible, the light is assumed
to come from above with the mean brightness of the scene.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.conventions import BACKGROUND, ROBOT, linear_from_srgb, srgb_from_linear
from aomgen.core.camera import Camera
from aomgen.core.environment_map import EnvironmentMap
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.least_squares import Kernel, ResidualTerm, solve
from aomgen.core.light import DIRECTIONS, Light, hemisphere_light, light_from_harmonics, open_transfer
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.sh import sh_basis, sphere_directions
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.lighting.probe import Probe, probe_light
from aomgen.lighting.visibility import Occluders, estimate_transfer
from aomgen.robots.robot import RobotModel
from aomgen.twin.twin import TwinModel, body_poses, pose_twin

# Smallest number of Gaussians on the robot that determine the light, and largest number that is used.
MIN_SAMPLES, MAX_SAMPLES = 200, 3000
# Largest distance of a Gaussian on the robot's surface from the posed meshes, [m].
MAX_DISTANCE: Final = 0.008
# Number of points sampled on each body of the robot.
POINTS_PER_BODY: Final = 3000
# Requirements on a sample: smallest sine of the angle between surface and viewing ray, smallest share of views that satisfy
# this, and smallest share of the sky that is not occluded.
FACING, MIN_EYES, MIN_OPEN = 0.2, 0.15, 0.25
# Share of the light that paint and plastic reflect specularly at normal incidence, for a refractive index of 1.5.
REFLECTED: Final = 0.04
# Color errors above this sRGB value are outliers, for example highlights or Gaussians of another link.
OUTLIER: Final = 0.05
# Standard deviations of the priors: of bands 1 and 2 of the unobserved radiance relative to its mean, and of the parameters
# of the tone curve; and the weight of one prior residual relative to all colors together.
BAND_SD, TONE_SD, PRIOR_COLORS = (0.6, 0.4), 0.3, 1e-4
# Relative decrease of the cost that ends the fit; the light then differs by 0.2 gray levels from the optimum.
TOLERANCE: Final = 1e-5
# Upper limits of the tone curve's shoulder and color loss.
MAX_TONE: Final = (2.0, 0.95)
# Weight of the residual of a table cell relative to a color of the robot; the grain of the table differs between cells.
TABLE: Final = 4.0
# Linear albedo limits: darker surfaces than the first value show reflections instead of diffuse light; up to the second
# value, they show both.
MIN_ALBEDO, BRIGHT = 0.05, 0.1
# Assumed mean albedo of a scene, which determines the brightness of the light if the robot does not.
MEAN_ALBEDO: Final = 0.4
# Largest image value, relative to the maximum of a tone curve, that is inverted to light.
BRIGHTEST: Final = 0.95
# Limits of the shown brightness of a white, horizontal surface, linear, 1 = image white.
LIMITS: Final = (0.3, 1.6)


class ToneCurve(NamedTuple):
    """Map from light to image colors, both linear, that does not change dark colors.

    Attributes:
        shoulder: Compression of brightness, >= 0: light of 1 is shown as 1 / (1 + shoulder).
        color_loss: Reduction of the saturation of a color with the brightness of white, 0..1; the reduction is proportional
            to the brightness.
    """

    shoulder: float = 0.0
    color_loss: float = 0.0

    def show(self, light: Array) -> Array:
        """Compute the image colors (..., 3) of light (..., 3)."""
        positive = np.maximum(light, 0)
        bent = positive / (1 + self.shoulder * positive)
        grey = bent.mean(-1, keepdims=True)
        return np.asarray(grey + self._kept(grey) * (bent - grey), np.float64)

    def undo(self, shown: Array) -> Array:
        """Compute the light (..., 3) that images show as given colors (..., 3)."""
        grey = shown.mean(-1, keepdims=True)
        bent = np.maximum(grey + (shown - grey) / self._kept(grey), 0)
        return np.asarray(bent / (1 - np.minimum(self.shoulder * bent, BRIGHTEST)), np.float64)

    def _kept(self, grey: Array) -> Array:
        return 1 - self.color_loss * np.minimum(grey, 1)


class SceneLight(NamedTuple):
    """Light on a new object, and the tone curve of the scene's images.

    Attributes:
        arriving: Light at the object's location.
        tone: Tone curve of the cameras.
        source: "robot"; "scene" if too little of the robot was visible; "file" or "diffusion" for a map.
    """

    arriving: Light
    tone: ToneCurve
    source: str

    @property
    def shown(self) -> Light:
        """Light under which white surfaces have the colors that the images show, without a tone curve."""
        transfer = open_transfer(sphere_directions(DIRECTIONS)).astype(np.float64)
        white = self.tone.show(transfer @ self.arriving.radiance_sh)
        return light_from_harmonics(np.linalg.lstsq(transfer, white)[0])


@dataclass(frozen=True, slots=True, kw_only=True)
class LitSamples:
    """N surface points: transfer past occluders (see `core.light`), and linear albedo and observed colors."""

    transfer: Annotated[Array, "N 9"]
    albedo: Annotated[Array, "N 3"]
    seen: Annotated[Array, "N 3"]

    __post_init__ = freeze_arrays

    def select(self, which: NDArray | slice) -> "LitSamples":
        """Select a subset of the points."""
        return LitSamples(transfer=self.transfer[which], albedo=self.albedo[which], seen=self.seen[which])


def estimate_light(
    twin: TwinModel,
    robot: RobotModel,
    around: Gaussians,
    place: Array,
    table: LitSamples,
    views: Sequence[Camera],
    rng: np.random.Generator,
) -> SceneLight:
    """Estimate the light of the scan.

    Args:
        twin: Recorded scene.
        robot: Robot in the scene.
        around: Static surroundings of the object, including those in its shadow, world frame.
        place: Location at which the light is estimated (3,), world frame.
        table: Samples of the table inside and outside the object's shadow.
        views: Cameras of the scan.
        rng: Generator that samples points on the robot.

    Not checked: whether the paint of the real robot agrees with its model; a uniform difference changes the brightness of the
    light, which is limited to `LIMITS`.
    """
    world = pose_twin(twin, robot, twin.scan_state)
    of_robot = (twin.labels == ROBOT) & (twin.bodies > 0)
    eyes = np.stack([view.center for view in views])
    samples = _robot_samples(twin, world, robot, eyes, rng)
    if not len(samples.albedo) >= MIN_SAMPLES:
        return SceneLight(scene_light(world, twin.labels), ToneCurve(), "scene")
    middle = np.median(world.means[of_robot], 0).astype(np.float64)
    here = probe_light(around, place, views)
    unseen, tone = fit_unseen(
        samples, probe_light(world.select(twin.labels != ROBOT), middle, views), table, here
    )
    light = SceneLight(light_from_harmonics(radiance_around(here, unseen, tone)), tone, "robot")
    shown = np.clip(tone.show(np.full(3, _up(light))), *LIMITS)
    return _with_level(light, float(tone.undo(shown)[0]))


def scene_light(world: Gaussians, labels: NDArray[np.uint8]) -> Light:
    """Make light from above whose brightness explains the scene's median color with the assumed mean albedo."""
    solid = (labels == BACKGROUND) & (world.opacities > 0.5)
    if not solid.any():
        return hemisphere_light(np.ones(3), np.full(3, 0.4))
    colors = linear_from_srgb(np.clip(0.5 + SH_C0 * world.sh[solid, 0], 0, 1))
    level = np.clip(np.median(colors, 0).mean() / MEAN_ALBEDO, *LIMITS)
    # A hemisphere of radiance L causes the irradiance pi L on a horizontal surface.
    return hemisphere_light(np.full(3, level), np.full(3, 0.4 * level))


def fit_unseen(samples: LitSamples, around: Probe, table: LitSamples, here: Probe) -> tuple[Array, ToneCurve]:
    """Fit the radiance from unobserved directions, as harmonics (9, 3), and the tone curve of the cameras.

    The tone curve is determined from dark and bright parts of the robot together. The light is determined from bright parts,
    because dark parts are affected by reflections.

    Args:
        samples: Samples on the robot.
        around: Visible radiance at the robot's center.
        table: Samples in the shadow of the recorded object and outside it.
        here: Visible radiance at the object's location.
    """
    _, tone = _explain(samples, around, table.select(slice(0)), here, None)
    bright = samples.select(samples.albedo.mean(1) > BRIGHT)
    return _explain(bright if len(bright.albedo) else samples, around, table, here, tone)


def _explain(
    samples: LitSamples, around: Probe, table: LitSamples, here: Probe, known: ToneCurve | None
) -> tuple[Array, ToneCurve]:
    """Fit the unobserved radiance, and the tone curve unless it is known, to samples and table."""
    wanted = srgb_from_linear(np.clip(samples.seen, 0, 1))
    grey = srgb_from_linear(np.clip(table.seen.mean(1, keepdims=True), 0, 1))
    spreads = np.repeat(BAND_SD, [3, 5])[:, None]
    weight = np.sqrt(PRIOR_COLORS * len(wanted))

    def compare(unknown: Array) -> Array:
        unseen, albedo, tone = unknown[:27].reshape(9, 3), unknown[27], known or ToneCurve(*unknown[28:])
        robot = (samples.albedo + REFLECTED) * (samples.transfer @ radiance_around(around, unseen, tone))
        level = albedo * (table.transfer @ radiance_around(here, unseen, tone)).mean(1, keepdims=True)
        shown, shadow = (srgb_from_linear(np.maximum(tone.show(light), 1e-6)) for light in (robot, level))
        mean = max(float(np.abs(unseen[0]).mean()), 1e-3)
        prior = np.append(unseen[1:] / (mean * spreads), unknown[28:] / TONE_SD)
        return np.concatenate([(shown - wanted).ravel(), TABLE * (shadow - grey).ravel(), weight * prior])

    limits = [(-np.inf, np.inf)] * 27 + [(0.01, 1.0)] + ([] if known else [(0.0, top) for top in MAX_TONE])
    low, high = np.transpose(limits)
    start = np.array([1.0] * 3 + [0.0] * 24 + [MEAN_ALBEDO] + ([] if known else [0.2, 0.1]))
    term = ResidualTerm(name="light", residual=compare, kernel=Kernel(scale=OUTLIER, power=0.5))
    found = solve(
        [term],
        start,
        retract=lambda unknown, step: np.clip(unknown + step, low, high),
        dimension=len(start),
        tolerance=TOLERANCE,
    ).state
    return found[:27].reshape(9, 3), known or ToneCurve(*found[28:])


def radiance_around(around: Probe, unseen: Array, tone: ToneCurve) -> Array:
    """Compute the harmonics (9, 3) of all light at a probe.

    Args:
        around: Visible radiance as shown by the images.
        unseen: Harmonics (9, 3) of the radiance from unobserved directions.
        tone: Tone curve of the images, which is inverted.
    """
    rest = np.maximum(sh_basis(around.directions, 2) @ unseen, 0)
    seen = around.seen[:, None]
    return around.project(seen * tone.undo(around.radiance_linear) + (1 - seen) * rest)


def light_of_map(around: EnvironmentMap, scan: SceneLight, source: str) -> SceneLight:
    """Make the light of an environment map, with the brightness and the tone curve of a scan's light.

    Args:
        around: Environment map.
        scan: Light of the scan; both lights have the same brightness on a horizontal white surface.
        source: Name of the map's origin, see `SceneLight`.
    """
    return _with_level(SceneLight(around.light(), scan.tone, source), _up(scan))


def _with_level(light: SceneLight, level: float) -> SceneLight:
    """Scale the light so that a horizontal white surface reflects a given radiance, linear."""
    return light._replace(arriving=light.arriving.scale_by(level / max(_up(light), 1e-6)))


def _up(light: SceneLight) -> float:
    """Compute the linear radiance that a horizontal white surface reflects, as the mean over the channels."""
    return float(light.arriving.irradiance(np.array([[0, 0, 1.0]])).mean())


def _robot_samples(
    twin: TwinModel, world: Gaussians, robot: RobotModel, eyes_world: Array, rng: np.random.Generator
) -> LitSamples:
    """Select the robot's Gaussians that are on the surface of its meshes and were observed by enough views."""
    Ts = body_poses(twin, robot, twin.scan_state)
    points, normals, colors = _surface_points(robot, Ts[1 : 1 + len(robot.body_names)], rng)
    mine = np.flatnonzero((twin.labels == ROBOT) & (world.opacities > 0.3) & (twin.bodies > 0))
    if not len(points):
        return LitSamples(transfer=np.zeros((0, 9)), albedo=colors, seen=colors)
    distances, nearest = cKDTree(points).query(world.means[mine])
    close = (distances < MAX_DISTANCE) & (colors[nearest].mean(1) > MIN_ALBEDO)
    mine, nearest = mine[close], nearest[close]
    if len(mine) > MAX_SAMPLES:
        chosen = rng.choice(len(mine), MAX_SAMPLES, replace=False)
        mine, nearest = mine[chosen], nearest[chosen]
    ways = eyes_world - points[nearest][:, None]
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    facing = np.einsum("nki,ni->nk", ways, normals[nearest]) > FACING
    often = facing.mean(1) > MIN_EYES
    mine, nearest = mine[often], nearest[often]
    # Links occlude light from each other and from themselves; enclosed points are not on the visible surface.
    transfer, open_ = estimate_transfer(points[nearest], normals[nearest], Occluders(points))
    outer = open_ > MIN_OPEN
    mine, nearest = mine[outer], nearest[outer]
    return LitSamples(
        transfer=transfer[outer],
        albedo=colors[nearest],
        seen=np.asarray(linear_from_srgb(np.clip(0.5 + SH_C0 * world.sh[mine, 0], 0, 1)), np.float64),
    )


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
