"""Estimate the directional light that casts the shadow of the robot on its work surface.

A fixed camera observes points of the surface in light and in shadow. A direction is correct if the shadow that the twin
would cast under light from there explains how the brightness of every point changes over time, independent of its color.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.optimize import minimize

from aomgen.conventions import linear_from_srgb
from aomgen.core.camera import Camera
from aomgen.core.light import DirectionalLight, spread_directions
from aomgen.core.sh import sphere_directions
from aomgen.core.transforms import apply, invert, make_tangent_basis
from aomgen.core.values import Array
from aomgen.lighting.plane_shadow import HEIGHTS, intersect_surface, measure_blocked_light, select_casters
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import render
from aomgen.splatting.surfaces import compute_rendered_points
from aomgen.twin.twin import CONTOUR_PX, PosedImages, TwinModel, body_poses, pose_bodies

# Number of images that are compared; one half is used for fitting, the other for validation.
IMAGES: Final = 16
# Every third image of the fitting half is used to evaluate the initial directions.
FIRST_EVERY: Final = 3
# Number of observed points of the surface.
POINTS: Final = 4000
# A point is visible if moving bodies cover less than this share of every pixel within `CONTOUR_PX` of it.
COVERED: Final = 0.02
# Smallest sRGB value that is compared; in darker pixels, noise exceeds the changes of light.
DARK: Final = 0.03
# Smallest sine of a light's elevation above the surface.
MIN_SINE: Final = 0.25
# Number of initial directions on the sphere; their spacing of about 8 degrees is less than the width of an arm's shadow.
FIRST_DIRECTIONS: Final = 350
# First step of the refinement, about half the spacing of the initial directions, and last step, [rad], which moves the
# shadow of a point at a height of 1 m by less than 0.5 cm.
FIRST_STEP, LAST_STEP = 0.07, 0.004
# Half angular widths of lights that are tested, [rad], for example of a spotlight, a lampshade, a nearby panel, a window.
WIDTHS: Final = (0.0, 0.05, 0.1, 0.15, 0.2)
# Smallest share of the variance in the validation images that the shadow must explain. With less, for example under soft
# light, most of the rendered shadow would be wrong.
MIN_EXPLAINED: Final = 0.5
# A point is in the core of a shadow if at least this share of the light is blocked.
CORE: Final = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceObservations:
    """Colors of N points of a surface in T images.

    Attributes:
        points: Points (N, 3), world frame.
        logs: Logarithms of linear colors (T, N, 3).
        seen: Mask (T, N) of points that are not occluded by moving bodies.
        casters: Result of `select_casters`.
        Ts_world_body: Poses of the bodies (T, B, 4, 4).
        T_world_plane: Pose of the surface (4, 4).
    """

    points: Array
    logs: Array
    seen: NDArray[np.bool_]
    casters: tuple[TwinModel, TwinModel]
    Ts_world_body: Array
    T_world_plane: Array

    def part(self, which: slice) -> "SurfaceObservations":
        """Select a subset of the images."""
        Ts = self.Ts_world_body[which]
        return replace(self, logs=self.logs[which], seen=self.seen[which], Ts_world_body=Ts)

    def block(self, directions: Array) -> Array:
        """Compute the share (T, N) of the light from directions (K, 3) that is blocked at the points."""
        Ts, T_world_plane = self.Ts_world_body, self.T_world_plane
        return measure_blocked_light(self.casters, Ts, T_world_plane, directions, self.points)

    def explain(self, directions: Array) -> float:
        """Compute the share of the brightness variance that the shadow of light from directions (K, 3) explains."""
        weight = self.seen.astype(np.float64)
        count = np.maximum(weight.sum(0), 1)
        # Both are compared without their means over time, because the points have different colors.
        bright, shadow = (
            values - (weight * values).sum(0) / count
            for values in (self.logs.mean(-1), self.block(directions))
        )
        below = (weight * shadow**2).sum() * (weight * bright**2).sum()
        slope = (weight * shadow * bright).sum()
        return float(slope**2 / below) if below > 0 and slope < 0 else 0.0


def find_directional_light(
    twin: TwinModel, robot: RobotModel, view: PosedImages, T_world_plane: Array
) -> DirectionalLight | None:
    """Find the directional light of a scene; None if no direction explains the images.

    Args:
        twin: Twin with all surfaces of its robot.
        robot: Robot of the twin.
        view: Images of a fixed camera with many joint configurations.
        T_world_plane: Pose (4, 4) of the surface whose brightness is observed.
    """
    observed = _observe_surface(twin, robot, view, _raise_plane(T_world_plane, twin, view.camera))
    if observed is None:
        return None
    fitted, unseen = observed.part(slice(0, None, 2)), observed.part(slice(1, None, 2))
    directions = sphere_directions(FIRST_DIRECTIONS)
    directions = directions[directions @ T_world_plane[:3, 2] > MIN_SINE]
    # A subset of the images is sufficient to compare the initial directions.
    few = fitted.part(slice(0, None, FIRST_EVERY))
    best = _refine_direction(max(directions, key=lambda direction: few.explain(direction[None])), fitted)
    width = max(WIDTHS, key=lambda width: fitted.explain(spread_directions(best, width)))
    spread = spread_directions(best, width)
    if unseen.explain(spread) < MIN_EXPLAINED:
        return None
    share = estimate_share(observed, observed.block(spread))
    if share is None or not ((share > 0) & (share < 1)).all():
        return None
    return DirectionalLight(directions=spread, share=share, T_world_plane=observed.T_world_plane)


def _refine_direction(direction: Array, observed: SurfaceObservations) -> Array:
    """Refine a direction (3,) by a simplex search in its tangent plane."""
    across = make_tangent_basis(direction)

    def turn(tangents: Array) -> Array:
        turned = direction + tangents @ across
        return turned / np.linalg.norm(turned)

    simplex = FIRST_STEP * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    options = {"initial_simplex": simplex, "xatol": LAST_STEP, "fatol": np.inf}

    def lose(tangents: Array) -> float:
        return -observed.explain(turn(tangents)[None])

    return turn(minimize(lose, [0, 0], method="Nelder-Mead", options=options).x)


def estimate_share(observed: SurfaceObservations, blocked: Array) -> Array | None:
    """Estimate the share (3,) of a directional light in the light on a surface.

    Only points in the core of the shadow and points far from it are compared, because the edge of the rendered shadow often
    deviates slightly from the real one.

    Args:
        observed: Colors of N points in T images.
        blocked: Blocked share (T, N) of the directional light.

    Returns:
        The share, linear RGB; None if no point was observed both in light and in shadow.
    """
    shadow = observed.seen & (blocked > CORE * blocked.max())
    light = observed.seen & (blocked < 1 - CORE)
    both = shadow.any(0) & light.any(0)
    if not both.any():
        return None
    values = np.concatenate([observed.logs[:, both], blocked[:, both, None]], -1)
    dark, bright = (
        (values * which[:, both, None]).sum(0) / which[:, both].sum(0)[:, None] for which in (shadow, light)
    )
    # Colors in shadow and in light are proportional to 1 - share * blocked.
    ratio = np.exp(dark[:, :3] - bright[:, :3])
    return np.median((1 - ratio) / (dark[:, 3:] - ratio * bright[:, 3:]), 0)


def _raise_plane(T_world_plane: Array, twin: TwinModel, camera: Camera) -> Array:
    """Move a surface (4, 4) along its normal to its observed height, because trained Gaussians are centered below it."""
    scene = render(twin.gaussians.select(twin.bodies == 0), camera, with_ids=True)
    heights = apply(invert(T_world_plane), compute_rendered_points(scene, camera))[..., 2]
    # Points are searched within the largest height at which they belong to the surface, above and below it. Invalid points are
    # NaN and fail this test.
    near = np.abs(heights) < HEIGHTS[-1]
    T = np.array(T_world_plane, np.float64)
    T[:3, 3] += T[:3, 2] * (float(np.median(heights[near])) if near.any() else 0.0)
    return T


def _observe_surface(
    twin: TwinModel, robot: RobotModel, view: PosedImages, T_world_plane: Array
) -> SurfaceObservations | None:
    """Collect the colors of points of the surface in some images of a video; None if no point is visible often enough."""
    count = len(view.states)
    chosen = np.unique(np.linspace(0, count - 1, min(IMAGES, count)).astype(int))
    camera, still = view.camera, twin.bodies == 0
    scene = render(twin.gaussians.select(still), camera, with_ids=True)
    points, belongs = intersect_surface(T_world_plane, camera, np.asarray(scene.median_depth, np.float64))
    Ts, moves = np.stack([body_poses(twin, robot, view.states[i]) for i in chosen]), ~still[:, None] * 1.0
    covered = [np.asarray(render(pose_bodies(twin, T), camera, features=moves).features)[..., 0] for T in Ts]
    free = np.stack([binary_erosion(image < COVERED, iterations=CONTOUR_PX) for image in covered])
    usable = np.flatnonzero((belongs > 0.99).ravel() & (free.sum(0) > len(chosen) / 2).ravel())
    if not len(usable):
        return None
    usable = usable[np.unique(np.linspace(0, len(usable) - 1, POINTS).astype(int))]
    colors = np.stack([view.images_srgb[i].reshape(-1, 3)[usable] for i in chosen]) / 255.0
    logs = np.log(linear_from_srgb(np.maximum(colors, DARK)))
    # The median over all points removes changes of exposure; most points are lit most of the time.
    logs -= np.median(logs - np.median(logs, 0), axis=1, keepdims=True)
    return SurfaceObservations(
        points=points.reshape(-1, 3)[usable],
        logs=np.asarray(logs, np.float64),
        seen=free.reshape(len(chosen), -1)[:, usable] & (colors.min(-1) > DARK),
        casters=select_casters(twin, robot),
        Ts_world_body=Ts,
        T_world_plane=T_world_plane,
    )
