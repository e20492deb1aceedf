"""Render the shadow of a directional light on a twin's surface, and remove the scanned shadow."""

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.conventions import illuminate_srgb, linear_from_srgb
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.light import DirectionalLight
from aomgen.core.values import Array
from aomgen.lighting.directional_light import CORE, DARK
from aomgen.lighting.plane_shadow import (
    intersect_surface,
    measure_blocked_light,
    select_casters,
    surface_share,
)
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import Rendering, render
from aomgen.twin.twin import TwinModel, TwinState, body_poses, pose_bodies

# Uncertainty of shadow edges, which corresponds to an error of the light's direction of one to two degrees, [m].
EDGE_M: Final = 0.015
# Smallest opacity of Gaussians that represent a surface.
SOLID: Final = 0.3
# Number of lit Gaussians whose median determines the color of the surface, which is robust to outliers.
NEIGHBORS: Final = 16


def render_state(
    twin: TwinModel, robot: RobotModel, state: TwinState, camera: Camera, **options: Any
) -> Rendering:
    """Render a twin in a state, with shadows.

    Args:
        twin, robot: Twin and its robot.
        state: State to be rendered.
        camera: Camera, world frame.
        **options: Passed to `splatting.rasterizer.render`.
    """
    Ts, directional = body_poses(twin, robot, state), twin.directional_light
    rendered = render(pose_bodies(twin, Ts), camera, **options)
    if directional is None:
        return rendered
    surface, blocked = observe_shadow(twin, directional, select_casters(twin, robot), Ts, camera)
    received = 1 - (surface * blocked)[..., None] * directional.share
    return replace(rendered, rgb=illuminate_srgb(rendered.rgb, received).astype(np.float32))


def pose_with_shadow(twin: TwinModel, robot: RobotModel, state: TwinState) -> Gaussians:
    """Transform all Gaussians to the world frame, in the order of the twin, and darken the surface by the shadow."""
    Ts, directional = body_poses(twin, robot, state), twin.directional_light
    world = pose_bodies(twin, Ts)
    if directional is None:
        return world
    means = world.means.astype(np.float64)
    share = surface_share(directional.T_world_plane, means) * (twin.bodies == 0)
    on_it = np.flatnonzero(share)
    casters = select_casters(twin, robot)
    blocked = np.zeros(len(means))
    light = measure_blocked_light(
        casters, Ts[None], directional.T_world_plane, directional.directions, means[on_it]
    )[0]
    blocked[on_it] = share[on_it] * light
    return world.illuminate(1 - blocked[:, None] * directional.share)


def observe_shadow(
    twin: TwinModel,
    directional: DirectionalLight,
    casters: tuple[TwinModel, TwinModel],
    Ts_world_body: Array,
    camera: Camera,
) -> tuple[Array, Array]:
    """Compute the share (H, W) of each pixel that shows the shadowed surface, and the blocked share (H, W) of the light.

    Args:
        twin: Twin.
        directional: Directional light of the twin.
        casters: Result of `select_casters`.
        Ts_world_body: Body poses (B, 4, 4).
        camera: Camera of the view.
    """
    still = (twin.bodies == 0).astype(np.float32)[:, None]
    rendered = render(pose_bodies(twin, Ts_world_body), camera, features=still, with_ids=True)
    depth = np.asarray(rendered.median_depth, np.float64)
    points, belongs = intersect_surface(directional.T_world_plane, camera, depth)
    blocked, seen, Ts = np.zeros(belongs.shape), belongs > 0, Ts_world_body[None]
    blocked[seen] = measure_blocked_light(
        casters, Ts, directional.T_world_plane, directional.directions, points[seen]
    )[0]
    return belongs * np.asarray(rendered.features)[..., 0], blocked


def remove_baked_shadow(twin: TwinModel, robot: RobotModel, directional: DirectionalLight) -> TwinModel:
    """Remove the scanned shadow of a directional light from the colors of the surface, and add the light to the twin."""
    Ts, T_world_plane = body_poses(twin, robot, twin.scan_state), directional.T_world_plane
    means = np.array(pose_bodies(twin, Ts).means, np.float64)
    share = surface_share(T_world_plane, means) * (twin.bodies == 0)
    on_it = np.flatnonzero(share)
    turns = np.arange(8) * np.pi / 4
    circle = EDGE_M * np.stack([np.cos(turns), np.sin(turns)], 1) @ T_world_plane[:3, :2].T
    shifted = (means[on_it] + np.concatenate([np.zeros((1, 3)), circle])[:, None]).reshape(-1, 3)
    around = np.zeros((9, len(means)))
    around[:, on_it] = share[on_it] * measure_blocked_light(
        select_casters(twin, robot), Ts[None], T_world_plane, directional.directions, shifted
    ).reshape(9, -1)
    blocked, most = around[0], around.max(0)
    # Only sharp shadows have uncertain edges; the shadow of a wide light has no sharp edges.
    unsure = (most - around.min(0) > 1 - CORE) & (len(directional.directions) == 1)
    lit = remove_shadow(twin.gaussians, blocked, directional)
    from_color = _find_shadow_by_color(lit, twin.gaussians, unsure, share, directional)
    blocked[unsure] = np.minimum(from_color, most[unsure])
    return replace(
        twin, gaussians=remove_shadow(twin.gaussians, blocked, directional), directional_light=directional
    )


def remove_shadow(gaussians: Gaussians, blocked: Array, directional: DirectionalLight) -> Gaussians:
    """Remove the shadow from N Gaussians, for which a share (N,) of the directional light was blocked."""
    return gaussians.illuminate(1 / (1 - blocked[:, None] * directional.share))


def _find_shadow_by_color(
    lit: Gaussians, seen: Gaussians, unsure: NDArray[np.bool_], share: Array, directional: DirectionalLight
) -> Array:
    """Estimate the blocked share of the light (M,), 0..1, of Gaussians at shadow edges from the colors of their neighbors.

    Args:
        lit: N Gaussians without the shadow, which are correct except at its edges.
        seen: The same Gaussians with the shadow.
        unsure: Mask (N,) of the M Gaussians at edges.
        share: Share of each Gaussian that belongs to the surface (N,).
    """
    sure = np.flatnonzero((share > CORE) & ~unsure & (seen.opacities > SOLID))
    count = min(NEIGHBORS, len(sure))
    if not count:
        return np.zeros(int(unsure.sum()))
    _, near = cKDTree(lit.means[sure]).query(seen.means[unsure], k=count)
    level = np.median(_measure_level(lit)[sure][near.reshape(-1, count)], 1)
    return np.clip((1 - _measure_level(seen)[unsure] / level) / directional.share.mean(), 0, 1)


def _measure_level(gaussians: Gaussians) -> Array:
    """Compute the linear brightness (N,) of Gaussians."""
    return np.asarray(linear_from_srgb(np.maximum(gaussians.colors_srgb, DARK)), np.float64).mean(1)
