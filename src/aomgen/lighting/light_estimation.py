"""The light at the location of a new object: radiance that the scan shows around it, and radiance inferred from the robot.

Walls, table and clutter are scanned, and so is the light that they send to the object. Light sources mostly are not: a scan looks
down. The robot is a surface whose shape and colors are known; what it receives beyond what is seen from it comes from
there. Where too little of the robot was seen, the light falls from above with the brightness of the scene.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from aomgen.conventions import BACKGROUND, ROBOT, linear_from_srgb, srgb_from_linear
from aomgen.core.camera import Camera
from aomgen.core.environment_map import EnvironmentMap
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.light import DIRECTIONS, Light, hemisphere_light, light_from_harmonics, open_transfer
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.sh import sh_basis, sphere_directions
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.lighting.probe import Probe, probe_light
from aomgen.lighting.visibility import Occluders, estimate_transfer
from aomgen.robots.robot import RobotModel
from aomgen.twin.twin import TwinModel, body_poses, pose_twin

# Fewer Gaussians on the robot do not constrain the light; more than the second number add no information.
MIN_SAMPLES, MAX_SAMPLES = 200, 3000
# A Gaussian farther than this from the posed meshes is not on their surface, [m].
MAX_DISTANCE: Final = 0.008
# Points drawn on each body of the robot.
POINTS_PER_BODY: Final = 3000
# Least sine of the angle between a surface and a view, least share of views above it, and least share of the sky above the surface.
FACING, MIN_EYES, MIN_OPEN = 0.2, 0.15, 0.25
# Share of the light that paint and plastic reflect beside their own color: normal incidence, refractive index 1.5.
REFLECTED: Final = 0.04
# Errors of colors beyond this are outliers: glints, wrong links, sRGB.
OUTLIER: Final = 0.05
# Standard deviations of bands 1 and 2 of what is not seen, shares of its mean, and of the tone curve; what share of all
# colors weighs as much as one of them.
BAND_SD, TONE_SD, PRIOR_COLORS = (0.6, 0.4), 0.3, 1e-4
# Shoulder and loss of color are at most these.
MAX_TONE: Final = (2.0, 0.95)
# A cell of the table weighs as much as this number of colors of the robot: its grain differs from cell to cell.
TABLE: Final = 4.0
# Nearly black surfaces show reflections rather than light; below the second number they show both, linear.
MIN_ALBEDO, BRIGHT = 0.05, 0.1
# Mean albedo of a scene, to judge the brightness of light when the robot cannot.
MEAN_ALBEDO: Final = 0.4
# Light is recovered from images up to this share of the brightest value that a tone curve shows at all.
BRIGHTEST: Final = 0.95
# Brightness of a white, level surface stays within these limits, linear, 1 = image white.
LIMITS: Final = (0.3, 1.6)


class ToneCurve(NamedTuple):
    """From light to image colors, both linear, dark light as it is.

    Attributes:
        shoulder: How much brightness is compressed, 0 or more: light of 1 is shown as 1 / (1 + shoulder).
        color_loss: Share of its distance from grey that a color as bright as white loses, below 1; darker ones lose less
            in proportion.
    """

    shoulder: float = 0.0
    color_loss: float = 0.0

    def show(self, light: Array) -> Array:
        """Colors (..., 3) of images of light."""
        positive = np.maximum(light, 0)
        bent = positive / (1 + self.shoulder * positive)
        grey = bent.mean(-1, keepdims=True)
        return np.asarray(grey + self._kept(grey) * (bent - grey), np.float64)

    def undo(self, shown: Array) -> Array:
        """Light (..., 3) of which images show colors."""
        grey = shown.mean(-1, keepdims=True)
        bent = np.maximum(grey + (shown - grey) / self._kept(grey), 0)
        return np.asarray(bent / (1 - np.minimum(self.shoulder * bent, BRIGHTEST)), np.float64)

    def _kept(self, grey: Array) -> Array:
        return 1 - self.color_loss * np.minimum(grey, 1)


class SceneLight(NamedTuple):
    """Light on a new object, and the tone curve with which the scene's images show it.

    Attributes:
        arriving: Where the object stands.
        tone: Of the cameras.
        source: "robot", or "scene" when too little of the robot was seen, or "file" or "diffusion" of a map.
    """

    arriving: Light
    tone: ToneCurve
    source: str

    @property
    def shown(self) -> Light:
        """The light in the colors in which images show white surfaces."""
        transfer = open_transfer(sphere_directions(DIRECTIONS)).astype(np.float64)
        white = self.tone.show(transfer @ self.arriving.radiance_sh)
        return light_from_harmonics(np.linalg.lstsq(transfer, white)[0])


@dataclass(frozen=True, slots=True, kw_only=True)
class LitSamples:
    """N places of a surface: what light its shape and what is around let through, its own colors and those seen, linear."""

    transfer: Annotated[Array, "N 9"]
    albedo: Annotated[Array, "N 3"]
    seen: Annotated[Array, "N 3"]

    __post_init__ = freeze_arrays

    def select(self, which: NDArray | slice) -> "LitSamples":
        """Some of them."""
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
    """Find the light that the scan was taken under.

    Args:
        twin: Recorded scene.
        robot: Its robot.
        around: What stands still about the object, in its shadow too, world frame.
        place: Location at which the light is estimated (3,), world frame.
        table: Of the table about the object, whose shadow falls on it.
        views: The scan's cameras.
        rng: Chooses points on the robot.

    Not checked: the real robot's paint may differ from its model; a uniform difference
    enters the light's brightness, which is limited to `LIMITS`.
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
    radiance = radiance_around(here, unseen, tone)
    return limit_light(SceneLight(light_from_harmonics(radiance), tone, "robot"))


def scene_light(world: Gaussians, labels: NDArray[np.uint8]) -> Light:
    """Light from above whose brightness explains the scene's mean color with a mean albedo."""
    solid = (labels == BACKGROUND) & (world.opacities > 0.5)
    if not solid.any():
        return hemisphere_light(np.ones(3), np.full(3, 0.4))
    colors = linear_from_srgb(np.clip(0.5 + SH_C0 * world.sh[solid, 0], 0, 1))
    level = np.clip(np.median(colors, 0).mean() / MEAN_ALBEDO, *LIMITS)
    # A half sphere of radiance L lights a level surface with irradiance pi L.
    return hemisphere_light(np.full(3, level), np.full(3, 0.4 * level))


def fit_unseen(samples: LitSamples, around: Probe, table: LitSamples, here: Probe) -> tuple[Array, ToneCurve]:
    """Radiance from directions in which the scan shows nothing, as harmonics (9, 3), and the camera's tone curve.

    Dark and bright parts of the robot together determine the curve. They show reflections too, so bright ones determine the light.

    Args:
        samples: On the robot.
        around: What is seen from its middle.
        table: In the shadow of the recorded object and outside it.
        here: What is seen from the object's place.
    """
    _, tone = _explain(samples, around, table.select(slice(0)), here, None)
    bright = samples.select(samples.albedo.mean(1) > BRIGHT)
    return _explain(bright if len(bright.albedo) else samples, around, table, here, tone)


def _explain(
    samples: LitSamples, around: Probe, table: LitSamples, here: Probe, known: ToneCurve | None
) -> tuple[Array, ToneCurve]:
    """The light, and the tone curve unless it is known, that explain samples and table best."""
    wanted = srgb_from_linear(np.clip(samples.seen, 0, 1))
    grey = srgb_from_linear(np.clip(table.seen.mean(1, keepdims=True), 0, 1))
    spreads = np.repeat(BAND_SD, [3, 5])[:, None]
    weight = np.sqrt(PRIOR_COLORS * len(wanted))

    def residuals(unknown: Array) -> Array:
        unseen, albedo, tone = unknown[:27].reshape(9, 3), unknown[27], known or ToneCurve(*unknown[28:])
        robot = (samples.albedo + REFLECTED) * (samples.transfer @ radiance_around(around, unseen, tone))
        level = albedo * (table.transfer @ radiance_around(here, unseen, tone)).mean(1, keepdims=True)
        shown, shadow = (srgb_from_linear(np.maximum(tone.show(light), 1e-6)) for light in (robot, level))
        mean = max(float(np.abs(unseen[0]).mean()), 1e-3)
        prior = np.append(unseen[1:] / (mean * spreads), unknown[28:] / TONE_SD)
        return np.concatenate([(shown - wanted).ravel(), TABLE * (shadow - grey).ravel(), weight * prior])

    start = np.concatenate([np.ones(3), np.zeros(24), [MEAN_ALBEDO, 0.2, 0.1]])
    low, high = np.full(30, -np.inf), np.full(30, np.inf)
    low[27:], high[27:] = (0.01, 0, 0), (1, *MAX_TONE)
    found = least_squares(residuals, start, bounds=(low, high), loss="soft_l1", f_scale=OUTLIER).x
    return found[:27].reshape(9, 3), known or ToneCurve(*found[28:])


def radiance_around(around: Probe, unseen: Array, tone: ToneCurve) -> Array:
    """Harmonics (9, 3) of all that arrives at a probe: what it sees, before the camera, and the rest."""
    rest = np.maximum(sh_basis(around.directions, 2) @ unseen, 0)
    seen = around.seen[:, None]
    return around.project(seen * tone.undo(around.radiance_linear) + (1 - seen) * rest)


def limit_light(light: SceneLight) -> SceneLight:
    """The light with the shown brightness of a level white surface inside `LIMITS`."""
    shown = np.clip(light.tone.show(np.full(3, _up(light))), *LIMITS)
    return _with_level(light, float(light.tone.undo(shown)[0]))


def light_of_map(around: EnvironmentMap, scan: SceneLight, source: str) -> SceneLight:
    """The light of a map, as bright on a level surface and shown as the light found in a scan."""
    return _with_level(SceneLight(around.light(), scan.tone, source), _up(scan))


def _with_level(light: SceneLight, level: float) -> SceneLight:
    """The light made brighter or darker, so that a level white surface sends back so much, linear."""
    return light._replace(arriving=light.arriving.scale_by(level / max(_up(light), 1e-6)))


def _up(light: SceneLight) -> float:
    """Radiance that a level white surface reflects, linear, mean of the channels."""
    return float(light.arriving.irradiance(np.array([[0, 0, 1.0]])).mean())


def _robot_samples(
    twin: TwinModel, world: Gaussians, robot: RobotModel, eyes_world: Array, rng: np.random.Generator
) -> LitSamples:
    """The robot's Gaussians that lie on its meshes and were seen from several sides."""
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
    # Links shade each other and themselves. Enclosed points are not on the visible surface.
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
