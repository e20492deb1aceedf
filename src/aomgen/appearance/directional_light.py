"""Estimation of the directional light that casts the shadow of the robot on its work surface.

A fixed camera sees the same place in light and in shadow. A direction is right when the shadow
that the posed twin would throw from there explains how the brightness of every place goes up and
down; the places' own colors do not enter.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from aomgen.appearance.surfel_observations import CONTOUR_PX, PosedImages
from aomgen.core.camera import Camera
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import render
from aomgen.splatting.surfaces import sphere_directions
from aomgen.twin.shadow import (
    HEIGHTS,
    MOVES,
    STANDS,
    DirectionalLight,
    compute_directional_shadow,
    intersect_surface,
    remove_shadow,
    silhouette,
    spread_directions,
    surface_share,
)
from aomgen.twin.twin import TwinModel, pose_twin, shadow_roles

# Images that are compared; a half of them to find the lamp, the other to judge it.
PICTURES: Final = 16
# Of the images that are fitted, every so many judge the first directions.
FIRST_EVERY: Final = 3
# Places of the surface that are watched.
PLACES: Final = 4000
# A place is seen when nothing that moves covers more than this of it, so many pixels around.
COVERED: Final = 0.02
# Lamps at least this high above the surface, as the sine of their elevation.
MIN_SINE: Final = 0.25
# First directions: every one has another within about 8 degrees, which is less than the width of an arm's shadow.
DIRECTIONS: Final = 350
# First step of the refinement, about half the spacing of the first directions, and where it ends, [rad]: that moves
# the shadow of a point 1 m high by less than half a centimeter.
FIRST_STEP, LAST_STEP = 0.07, 0.004
# Half the angles under which a lamp may be seen, [rad]: a spot, a bulb's shade, a panel near by, a window.
WIDTHS: Final = (0.0, 0.05, 0.1, 0.15, 0.2)
# The shadow has to take away at least this share of the variance in images it was not fitted to.
# With less, as under soft light, most of what it draws would be wrong.
MIN_EXPLAINED: Final = 0.5
# What is this much in shadow is wholly in it.
CORE: Final = 0.95
# Edges of shadows are this uncertain, a degree or two of the light's direction, [m].
EDGE_M: Final = 0.015
# Gaussians that count as surface, and how many around one tell its color.
SOLID: Final = 0.3
# Lit Gaussians whose median gives the color of the surface: outvotes single outliers.
NEIGHBORS: Final = 16
# Brightness is compared above this, sRGB: below, noise counts more than light.
DARK: Final = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceObservations:
    """Places of the surface over time, T images and N places.

    Attributes:
        points: World frame (N, 3).
        logs: Logarithms of sRGB colors (T, N, 3).
        seen: (T, N), whether nothing moving hides it.
        moving: What throws shadows that come and go, in every image, world frame.
        fixed: What throws the same shadow in all of them.
    """

    points: Array
    logs: Array
    seen: NDArray[np.bool_]
    moving: tuple[Gaussians, ...]
    fixed: Gaussians

    def part(self, which: slice) -> "SurfaceObservations":
        """Some of the images."""
        return replace(self, logs=self.logs[which], seen=self.seen[which], moving=self.moving[which])

    def dark(self, directions: Array) -> Array:
        """Share (T, N) of the light of a lamp, directions (K, 3), that the moving bodies take from the places."""
        found = np.zeros((len(self.moving), len(self.points)))
        for way in directions:
            lit = 1 - silhouette(self.fixed, way).at(self.points)
            found += [silhouette(bodies, way).at(self.points) * lit for bodies in self.moving]
        return found / len(directions)


def find_directional_light(
    twin: TwinModel, robot: RobotModel, view: PosedImages, T_world_plane: Array
) -> DirectionalLight | None:
    """Find the directional light of a scene; None when no direction explains the video.

    Args:
        twin: With all surfaces of its robot.
        view: A fixed camera's images of many joint configurations.
        T_world_plane: Surface (4, 4) whose brightness is watched.
    """
    T_world_plane = raise_plane(T_world_plane, twin, view.camera)
    observed = _observe_surface(twin, robot, view, T_world_plane)
    if observed is None:
        return None
    up = T_world_plane[:3, 2]
    fitted, unseen = observed.part(slice(0, None, 2)), observed.part(slice(1, None, 2))
    directions = sphere_directions(DIRECTIONS)
    directions = directions[directions @ up > MIN_SINE]

    def score(images: SurfaceObservations) -> Callable[[Array], float]:
        return lambda direction: measure_explained_variance(images, images.dark(direction[None]))

    # Some of the images tell the first directions apart.
    first = max(directions, key=score(fitted.part(slice(0, None, FIRST_EVERY))))
    best = _refine_direction(first, score(fitted))
    wide = {width: spread_directions(best, width) for width in WIDTHS}
    width = max(wide, key=lambda width: measure_explained_variance(fitted, fitted.dark(wide[width])))
    if measure_explained_variance(unseen, unseen.dark(wide[width])) < MIN_EXPLAINED:
        return None
    shade = estimate_shadow_color(observed, observed.dark(wide[width]))
    if shade is None or not ((shade > 0) & (shade < 1)).all():
        return None
    return DirectionalLight(direction=best, width=width, T_world_plane=T_world_plane, shade=shade)


def remove_baked_shadow(twin: TwinModel, robot: RobotModel, lamp: DirectionalLight) -> TwinModel:
    """Remove the baked shadow: surface colors become those in light, and shadows are cast by the twin."""
    world = pose_twin(twin, robot, twin.scan_state)
    points = np.array(world.means, np.float64)
    roles = shadow_roles(twin, robot)
    on_it = surface_share(lamp.T_world_plane, points) * (twin.bodies == 0)

    turns = np.arange(8) * np.pi / 4
    circle = EDGE_M * np.stack([np.cos(turns), np.sin(turns)], 1) @ lamp.T_world_plane[:3, :2].T
    shifted = points + np.concatenate([np.zeros((1, 3)), circle])[:, None]
    around = on_it * compute_directional_shadow(world, roles, lamp.directions, shifted)
    dark, darkest = around[0], around.max(0)
    # A wide lamp has no edges to be beside.
    unsure = (darkest - around.min(0) > 1 - CORE) & (not lamp.width)
    lit = remove_shadow(twin.gaussians, dark, lamp.shade)
    from_color = _shadow_from_color(lit, twin.gaussians, unsure, on_it, lamp)
    dark[unsure] = np.minimum(from_color, darkest[unsure])
    return replace(twin, gaussians=remove_shadow(twin.gaussians, dark, lamp.shade), directional_light=lamp)


def _shadow_from_color(
    lit: Gaussians, seen: Gaussians, unsure: NDArray[np.bool_], on_it: Array, lamp: DirectionalLight
) -> Array:
    """How much Gaussians at edges of a shadow are in it (M,), 0..1: by how dark they are beside others in light.

    Args:
        lit: All Gaussians without the shadow, right away from its edges.
        seen: The same with it.
        unsure: Which are at edges, M of N.
        on_it: Share (N,) of the surface.
    """
    sure = np.flatnonzero((on_it > CORE) & ~unsure & (seen.opacities > SOLID))
    count = min(NEIGHBORS, len(sure))
    if not count:
        return np.zeros(int(unsure.sum()))
    _, near = cKDTree(lit.means[sure]).query(seen.means[unsure], k=count)
    level = np.median(_level(lit)[sure][near.reshape(-1, count)], 1)
    return np.clip((1 - _level(seen)[unsure] / level) / (1 - lamp.shade.mean()), 0, 1)


def _level(gaussians: Gaussians) -> Array:
    return np.maximum(0.5 + SH_C0 * gaussians.sh[:, 0].astype(np.float64), DARK).mean(1)


def measure_explained_variance(observed: SurfaceObservations, dark: Array) -> float:
    """Share of the variance of brightness over time that shadows (T, N), 0..1, account for; 0 for none.

    Every place has its own color, so both are compared without their means over time.
    """
    weight = observed.seen.astype(np.float64)
    count = np.maximum(weight.sum(0), 1)
    bright, shadow = (values - (weight * values).sum(0) / count for values in (observed.logs.mean(-1), dark))
    below = (weight * shadow**2).sum() * (weight * bright**2).sum()
    slope = (weight * shadow * bright).sum()
    return float(slope**2 / below) if below > 0 and slope < 0 else 0.0


def _refine_direction(direction: Array, score: Callable[[Array], float]) -> Array:
    """The best direction around one, by simplex search over its tangents."""
    side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    side /= np.linalg.norm(side)
    across = np.stack([side, np.cross(direction, side)])

    def turn(tangents: Array) -> Array:
        turned = direction + tangents @ across
        return turned / np.linalg.norm(turned)

    simplex = FIRST_STEP * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    options = {"initial_simplex": simplex, "xatol": LAST_STEP, "fatol": np.inf}
    found = minimize(lambda tangents: -score(turn(tangents)), [0, 0], method="Nelder-Mead", options=options)
    return turn(found.x)


def estimate_shadow_color(observed: SurfaceObservations, dark: Array) -> Array | None:
    """Color in shadow over color in light (3,), of places seen in both; None when there are none.

    Only what is in the core of a shadow, or far from all, is compared: at edges a shadow is often
    a little beside where it is drawn. The core of a wide lamp's shadow still has some of its light.
    """
    deepest = float(dark.max())
    shadow, light = observed.seen & (dark > CORE * deepest), observed.seen & (dark < 1 - CORE)
    both = shadow.any(0) & light.any(0)
    if not both.any():
        return None
    mean = [
        (observed.logs[:, both] * which[:, both, None]).sum(0) / which[:, both].sum(0)[:, None]
        for which in (shadow, light)
    ]
    return 1 - (1 - np.exp(np.median(mean[0] - mean[1], 0))) / deepest


def raise_plane(T_world_plane: Array, twin: TwinModel, camera: Camera) -> Array:
    """Move a surface (4, 4) along its normal to where a camera sees it.

    Centers of trained Gaussians lie below the surface that they paint.
    """
    scene = render(twin.gaussians.select(twin.bodies == 0), camera, with_ids=True)
    depth = np.asarray(scene.median_depth, np.float64)
    points = (camera.center + camera.directions() * depth[..., None])[depth > 0]
    heights = apply(invert(T_world_plane), points)[:, 2]
    # Seen points fade out of the surface that far above it; they are looked for as far below.
    near = np.abs(heights) < HEIGHTS[-1]
    if not near.any():
        return T_world_plane
    T = np.array(T_world_plane)
    T[:3, 3] += T[:3, 2] * float(np.median(heights[near]))
    return T


def _observe_surface(
    twin: TwinModel, robot: RobotModel, view: PosedImages, T_world_plane: Array
) -> SurfaceObservations | None:
    """Places of the surface in some images of a video; None when it is hardly seen."""
    count = len(view.states)
    chosen = np.unique(np.linspace(0, count - 1, min(PICTURES, count)).astype(int))
    camera, still = view.camera, twin.bodies == 0
    roles = shadow_roles(twin, robot)
    scene = render(twin.gaussians.select(still), camera, with_ids=True)
    points, belongs = intersect_surface(T_world_plane, camera, np.asarray(scene.median_depth, np.float64))
    moving, free = [], []
    for index in chosen:
        world = pose_twin(twin, robot, view.states[index])
        covered = render(world, camera, features=(~still)[:, None].astype(np.float32)).features
        moving.append(world.select(roles == MOVES))
        free.append(binary_erosion(np.asarray(covered)[..., 0] < COVERED, iterations=CONTOUR_PX))
    seen = np.stack(free)
    usable = np.flatnonzero((belongs > 0.99).ravel() & (seen.sum(0) > len(chosen) / 2).ravel())
    if not len(usable):
        return None
    usable = usable[np.unique(np.linspace(0, len(usable) - 1, PLACES).astype(int))]
    colors = np.stack([view.images_srgb[i].reshape(-1, 3)[usable] for i in chosen]) / 255.0
    seen = seen.reshape(len(chosen), -1)[:, usable] & (colors.min(-1) > DARK)
    logs = np.log(np.maximum(colors, DARK))
    # Exposure changes everything at once; most places are lit most of the time.
    logs -= np.median(logs - np.median(logs, 0), axis=1, keepdims=True)
    return SurfaceObservations(
        points=points.reshape(-1, 3)[usable],
        logs=logs,
        seen=seen,
        moving=tuple(moving),
        fixed=pose_twin(twin, robot, view.states[0]).select(roles == STANDS),
    )
