"""Take the recorded object out of the scene and close the surface it stood on."""

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
from aomgen.lighting.table_shadow import ShadowedTable, select_lit_cells, shadow_gain
from aomgen.replacement.table_texture import Photograph, continue_smoothly, photograph_surface
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import contribution_weights
from aomgen.twin.plan_view import PlanView
from aomgen.twin.support import SURFACE, Support, find_support, on_surface
from aomgen.twin.twin import TwinModel, pose_twin

# Remains of the object are looked for this far around it, [m].
HALO: Final = 0.025
# Gaussians of which the object hid more than all but this share are unknown.
SEEN_SHARE: Final = 0.2
# The surface is replaced this far beyond the object's footprint, [m].
MARGIN: Final = 0.045
# Photographs show the object's foot within this distance of the footprint, [m].
FOOT: Final = 0.02
# Colors in deeper shadows, whose light would be multiplied by more than this factor, are inpainted, linear.
MAX_LIFT: Final = 1.94
# Texture and shadow are judged on a ring this wide, [m].
RING: Final = 0.28
# Cell of the image from above, [m].
CELL: Final = 0.004
# Difference of chromaticity from most of the surface that certainly belongs to another object.
MIN_TINT: Final = 0.07
# Width over which one surface fades into the other, [m].
FADE: Final = 0.05
# New surface lies this far below the old one, so that the old covers it where it is sound, [m].
BELOW: Final = 0.0015
# Standard deviation and thickness of a cell's Gaussian, in cells, and its opacity.
SPREAD, THICKNESS, OPACITY = 0.8, 0.1, 0.98
# The old surface has no gaps where it covers at least this share.
SOUND: Final = 0.6

Inpaint = Callable[[Array, NDArray[np.bool_]], Array]


class Cleared(NamedTuple):
    """A scene without its object.

    Attributes:
        twin: All labels are background or robot; no Gaussian belongs to "object" or "part".
        shadowed: All that never moves, as it was scanned: with the object's shadow on it, without new surface; world frame.
        support: The plane the object stood on.
        table: Places on it as they were scanned, in the object's shadow too.
        removed: Number of Gaussians removed beyond those labelled as the object.
        filled: Gaussians of new surface.
    """

    twin: TwinModel
    shadowed: Gaussians
    support: Support
    table: LitSamples
    removed: int
    filled: int

    @property
    def surroundings(self) -> Gaussians:
        """All that never moves, world frame."""
        return self.twin.scene


def clear_object(
    twin: TwinModel, robot: RobotModel, views: Sequence[Photograph], inpaint: Inpaint
) -> Cleared:
    """Remove the recorded object from a bound scan.

    Args:
        twin: Bound scan.
        robot: Its robot.
        views: Photographs of the scan: what they saw of the surface is put back, the rest is invented.
        inpaint: Completes an image (H, W, 3), 0..1, of the surface from straight above where it is not known (H, W).

    Raises:
        ReconstructionError: No supporting plane was scanned.
    """
    world = pose_twin(twin, robot, twin.scan_state)
    of_object = np.isin(twin.labels, (STATIC, MOVING))
    scene = twin.of_scene
    support = find_support(
        world.means[of_object], world.opacities[of_object], world.select(scene), twin.T_world_object
    )
    leftover = scene & (_leftover(world, support) | _hardly_seen(world, of_object, views))
    remaining = twin.select(~of_object & ~leftover)
    plan = PlanView(support=support, low=support.low - RING, high=support.high + RING, cell=CELL)
    outside = support.outside(plan.xy)
    picture, seen = photograph_surface(world, scene, views, support.T_world_plane, plan.xy)
    covered = seen & (outside > FOOT)
    known = _same_material(picture, covered)
    near, other = outside < MARGIN, covered & ~known
    # Surfaces close to the footprint that are not the table belong to the object: its foot, its mirror image.
    of_foot = plan.lookup(other & near, remaining.gaussians, False)
    rest = of_foot & remaining.of_scene & on_surface(remaining.gaussians, support)
    remaining = remaining.select(~rest)
    shadowed = ShadowedTable(
        caster=world.select(of_object), T_world_plane=support.T_world_plane, low=plan.low, cell=CELL,
        picture_srgb=picture, known=known,
    )  # fmt: skip
    table, gain = select_lit_cells(shadowed, np.random.default_rng(0)), shadow_gain(shadowed)
    deep = known & (gain.max(-1) > MAX_LIFT)
    known = known & ~deep
    level = remaining.of_scene & on_surface(remaining.gaussians, support)
    factors = np.where(level[:, None], plan.lookup(gain, remaining.gaussians, 1.0), 1.0)
    lightened = remaining.gaussians.illuminate(factors)
    texture = inpaint(np.minimum(illuminate_srgb(picture, gain), 1), known)
    # The table ends where nothing was scanned before either; gaps within it are closed too.
    area = (outside <= 0) | (_hull(plan.cover(world.select(scene)) > 0.5) & (near | ~binary_dilation(other)))
    new, closed = area & (near | deep), outside <= 0.7 * RING
    fill, kept = renew_surface(lightened, level, plan, texture, known, new, closed, area)
    faded = replace(lightened, opacities=lightened.opacities * kept)
    cleared = replace(remaining, gaussians=faded).select(kept > 0).extend(fill, 0, BACKGROUND)
    removed = int(leftover.sum() + rest.sum())
    return Cleared(cleared, remaining.scene, support, table, removed=removed, filled=len(fill))


def _leftover(world: Gaussians, support: Support) -> NDArray[np.bool_]:
    """Remains of the object that were not labelled so: its halo, and the unseen surface beneath it."""
    places = support.coordinates(world.means)
    outside, beyond = support.outside(places[:, :2]), support.beyond_reach(places[:, :2])
    above = (places[:, 2] > SURFACE) & (places[:, 2] < support.top + HALO) & (beyond < HALO)
    # Faint splats that hang in the air a little further out are halo too.
    faint = (world.opacities < 0.3) & (places[:, 2] > SURFACE) & (places[:, 2] < support.top + 2 * HALO)
    beneath = (np.abs(places[:, 2]) <= 0.04) & (places[:, 2] <= SURFACE) & (outside < MARGIN)
    return above | (faint & (beyond < 2 * HALO)) | beneath


def _hardly_seen(
    world: Gaussians, of_object: NDArray[np.bool_], views: Sequence[Photograph]
) -> NDArray[np.bool_]:
    """Select Gaussians (N,) that the object hid from nearly all views that would see them without it: no photograph confirms
    them.
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
    """Cells (H, W) inside the convex hull of the largest connected patch; tables are convex."""
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
    """Known cells (H, W) that look like most of the surface, lit or in shadow, not like objects on it."""
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
    """Flat Gaussians, one a cell, and the share (N,) of their opacity that the old ones keep.

    An image from above has no gloss, and trained surfaces look different from every side. Their difference from
    the image is continued smoothly; then both surfaces fade into each other.

    Args:
        old: All that is there, world frame.
        table: Which of it (N,) is the surface.
        plan: The surface from above.
        texture: Its image, 0..1.
        known: Where that was photographed.
        new: Where nothing of the old surface shall stay.
        closed: Where gaps in it are closed too.
        area: Where it is, and no flat object lies on it.
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
    # Feet of objects on the surface, which are neither known nor new, stay.
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
