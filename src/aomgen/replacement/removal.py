"""Remove the recorded object from the scene and complete the surface below it."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import (
    binary_dilation,
    binary_opening,
    distance_transform_edt,
    gaussian_filter,
    label,
)
from scipy.spatial import ConvexHull

from aomgen.conventions import BACKGROUND, MOVING, STATIC, illuminate_srgb
from aomgen.core.gaussians import SH_C0, Gaussians, gaussians_of
from aomgen.core.transforms import apply, quat_from_matrix
from aomgen.core.values import Array
from aomgen.lighting.light_estimation import LitSamples
from aomgen.lighting.table_shadow import select_lit_cells, shadow_gain
from aomgen.replacement.table_texture import Photograph, continue_smoothly, photograph_surface
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import contribution_weights
from aomgen.twin.plan_view import PlanView
from aomgen.twin.support import SURFACE, Support, find_support, on_surface
from aomgen.twin.twin import TwinModel, pose_twin

# Distance around the object within which its remains are searched, [m].
HALO: Final = 0.025
# Gaussians whose share of unoccluded pixels is smaller are unknown, because the object occluded the others.
SEEN_SHARE: Final = 0.2
# Distance beyond the footprint of the object up to which the surface is replaced, [m].
MARGIN: Final = 0.045
# Distance from the footprint within which photographs show the foot of the object, [m].
FOOT: Final = 0.02
# Largest factor on linear light that removes a shadow; colors in deeper shadows are inpainted.
MAX_LIFT: Final = 1.94
# Width of the ring on which texture and shadow are measured, [m].
RING: Final = 0.28
# Cell size of the top view, [m].
CELL: Final = 0.004
# Chromaticity difference from most of the surface from which on a cell belongs to another object.
MIN_TINT: Final = 0.07
# Width of the transition between old and new surface, [m].
FADE: Final = 0.05
# Distance of the new surface below the old one, which covers it where the old one has no gaps, [m].
BELOW: Final = 0.0015
# Standard deviation and thickness of a cell's Gaussian, in cells, and its opacity.
SPREAD, THICKNESS, OPACITY = 0.8, 0.1, 0.98
# Coverage from which on the old surface has no gaps.
SOUND: Final = 0.6

Inpaint = Callable[[Array, NDArray[np.bool_]], Array]


class Cleared(NamedTuple):
    """A scene without its object.

    Attributes:
        twin: Twin whose labels are background or robot; no Gaussian belongs to "object" or "part".
        shadowed: Static Gaussians as scanned, with the object's shadow and without the new surface; world frame.
        support: Support plane of the object.
        table: Cells of the support plane as scanned, including those in the object's shadow.
        removed: Number of removed Gaussians that were not labeled as the object.
        filled: Number of Gaussians of the new surface.
    """

    twin: TwinModel
    shadowed: Gaussians
    support: Support
    table: LitSamples
    removed: int
    filled: int


def clear_object(
    twin: TwinModel, robot: RobotModel, views: Sequence[Photograph], inpaint: Inpaint
) -> Cleared:
    """Remove the recorded object from a bound scan.

    Args:
        twin: Bound scan.
        robot: Its robot.
        views: Photographs of the scan; observed parts of the surface are restored from them, other parts are inpainted.
        inpaint: Function that completes the unknown pixels (H, W) of a top view (H, W, 3), 0..1, of the surface.

    Raises:
        ReconstructionError: No supporting plane was scanned.
    """
    world = pose_twin(twin, robot, twin.scan_state)
    of_object = np.isin(twin.labels, (STATIC, MOVING))
    caster, scene = world.select(of_object), twin.of_scene
    support = find_support(caster, world.select(scene), twin.T_world_object)
    leftover = scene & (_leftover(world, support) | _hardly_seen(world, of_object, views))
    remaining = twin.select(~of_object & ~leftover)
    plan = PlanView(support=support, low=support.low - RING, high=support.high + RING, cell=CELL)
    outside = support.outside(plan.xy)
    picture, seen = photograph_surface(world, scene, views, support.T_world_plane, plan.xy)
    covered = seen & (outside > FOOT)
    known = _same_material(picture, covered)
    near, other = outside < MARGIN, covered & ~known
    # Surfaces close to the footprint that are not the table belong to the object, for example its foot or mirror image.
    of_foot = plan.lookup(other & near, remaining.gaussians, False)
    rest = of_foot & remaining.of_scene & on_surface(remaining.gaussians, support)
    remaining = remaining.select(~rest)
    table = select_lit_cells(caster, plan, picture, known, np.random.default_rng(0))
    gain = shadow_gain(caster, plan, picture, known)
    deep = known & (gain.max(-1) > MAX_LIFT)
    known = known & ~deep
    level = remaining.of_scene & on_surface(remaining.gaussians, support)
    factors = np.where(level[:, None], plan.lookup(gain, remaining.gaussians, 1.0), 1.0)
    lightened = remaining.gaussians.illuminate(factors)
    texture = inpaint(np.minimum(illuminate_srgb(picture, gain), 1), known)
    # The table ends at the border of the scanned region; gaps within it are closed as well.
    area = (outside <= 0) | (_hull(plan.cover(world.select(scene)) > 0.5) & (near | ~binary_dilation(other)))
    new, closed = area & (near | deep), outside <= 0.7 * RING
    fill, kept = renew_surface(lightened, level, plan, texture, known, new, closed, area)
    faded = replace(lightened, opacities=lightened.opacities * kept)
    cleared = replace(remaining, gaussians=faded).select(kept > 0).extend(fill, 0, BACKGROUND)
    removed = int(leftover.sum() + rest.sum())
    return Cleared(cleared, remaining.scene, support, table, removed=removed, filled=len(fill))


def _leftover(world: Gaussians, support: Support) -> NDArray[np.bool_]:
    """Find remains of the object that are not labeled as such: its halo, and the unobserved surface below it."""
    places = support.coordinates(world.means)
    outside, beyond = support.outside(places[:, :2]), support.beyond_reach(places[:, :2])
    above = (places[:, 2] > SURFACE) & (places[:, 2] < support.top + HALO) & (beyond < HALO)
    # Faint Gaussians above the surface, at a slightly larger distance, belong to the halo as well.
    faint = (world.opacities < 0.3) & (places[:, 2] > SURFACE) & (places[:, 2] < support.top + 2 * HALO)
    beneath = (np.abs(places[:, 2]) <= 0.04) & (places[:, 2] <= SURFACE) & (outside < MARGIN)
    return above | (faint & (beyond < 2 * HALO)) | beneath


def _hardly_seen(
    world: Gaussians, of_object: NDArray[np.bool_], views: Sequence[Photograph]
) -> NDArray[np.bool_]:
    """Select Gaussians (N,) that the object occludes in nearly all views in which they would be visible without it.

    No photograph confirms these Gaussians.
    """
    others = world.select(~of_object)
    shown, bare = np.zeros(len(world)), np.zeros(len(others))
    for view in views:
        whole = np.ones((1, view.camera.height, view.camera.width), np.float32)
        shown += contribution_weights(world, view.camera, whole)[:, 0]
        bare += contribution_weights(others, view.camera, whole)[:, 0]
    hidden = np.zeros(len(world), bool)
    hidden[~of_object] = shown[~of_object] < SEEN_SHARE * bare
    return hidden


def _hull(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find cells (H, W) inside the convex hull of the largest connected region, because tables are convex."""
    opened = binary_opening(cells, iterations=2)
    components = np.zeros(cells.shape, np.int32)
    if not label(opened, output=components):
        return cells
    largest = components == 1 + np.bincount(components.ravel())[1:].argmax()
    hull = ConvexHull(np.argwhere(largest))
    places = np.argwhere(np.ones(cells.shape, bool))
    inside = (places @ hull.equations[:, :2].T + hull.equations[:, 2] <= 1e-9).all(1)
    return np.asarray(inside).reshape(cells.shape)


def _same_material(picture: Array, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find known cells (H, W) with the chromaticity of most of the surface, lit or in shadow."""
    if not known.sum() > 200:
        return known
    smooth = gaussian_filter(picture, (1, 1, 0))
    brightness = smooth.mean(-1)
    chroma = smooth / np.maximum(3 * brightness, 1e-3)[..., None]
    tint = np.abs(chroma - np.median(chroma[known], 0)).max(-1)
    level = np.log(np.maximum(brightness, 1e-3)) - np.log(np.median(brightness[known]))
    other = (tint > max(4 * float(np.median(tint[known])), MIN_TINT)) | (level < -1.2)
    other |= level > max(4 * float(np.median(np.abs(level[known]))), 0.3)
    return known & ~binary_dilation(other & known, iterations=2)


def renew_surface(
    old: Gaussians,
    table: NDArray[np.bool_],
    plan: PlanView,
    texture: Array,
    known: NDArray[np.bool_],
    new: NDArray[np.bool_],
    closed: NDArray[np.bool_],
    area: NDArray[np.bool_],
) -> tuple[Gaussians, NDArray[np.float32]]:
    """Create flat Gaussians, one for each cell, and compute the share (N,) of opacity that the old Gaussians keep.

    A top view has no view-dependent gloss, whereas trained surfaces have. The difference between them is extrapolated
    smoothly, and the two surfaces are blended.

    Args:
        old: Gaussians of the scene, world frame.
        table: Mask (N,) of the Gaussians of the surface.
        plan: Cells of the top view of the surface.
        texture: Image of the surface, 0..1.
        known: Cells whose texture was photographed.
        new: Cells in which the old surface is removed completely.
        closed: Cells in which gaps of the old surface are closed.
        area: Cells of the surface without flat objects on them.
    """
    sh = old.sh[table].reshape(int(table.sum()), -1)
    around, cover = plan.mean(old.select(table), sh)
    sound = cover >= SOUND
    # Harmonics that the trained surface has in addition to its image.
    around[..., :3] -= (texture - 0.5) / SH_C0
    looks = continue_smoothly(around, known & sound).reshape(*plan.shape, -1, 3)
    filled = area & (new | (closed & ~sound))
    beyond = np.asarray(distance_transform_edt(~filled)) * plan.cell
    fill = _flat(plan, texture, looks, np.clip(2 - 2 * beyond / FADE, 0, 1) * area)
    # Feet of objects on the surface, which are neither known nor new, remain.
    kept = np.where(known | new, np.clip(2 * beyond / FADE, 0, 1), 1.0)
    return fill, np.where(table, plan.lookup(kept, old, 1.0), 1.0).astype(np.float32)


def _flat(plan: PlanView, texture: Array, looks: Array, opacity: Array) -> Gaussians:
    where = opacity > 0
    count, T = int(where.sum()), plan.support.T_world_plane
    sh = looks[where]
    sh[:, 0] += (texture[where] - 0.5) / SH_C0
    side = SPREAD * plan.cell
    return gaussians_of(
        means=apply(T, np.column_stack([plan.xy[where], np.full(count, -BELOW)])),
        quats=np.broadcast_to(quat_from_matrix(T[:3, :3]), (count, 4)),
        scales=np.broadcast_to([side, side, THICKNESS * plan.cell], (count, 3)),
        opacities=OPACITY * opacity[where],
        sh=sh,
    )
