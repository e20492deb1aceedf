"""Take the recorded object out of the scene and close the surface it stood on.

Unknown places of that get smooth color from their border and texture from patches.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_opening, distance_transform_edt, gaussian_filter, label
from scipy.sparse.linalg import LaplacianNd, spsolve
from scipy.spatial import ConvexHull

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.gaussians import SH_C0, Gaussians, gaussians_of
from aomgen.core.transforms import apply, quat_from_matrix
from aomgen.core.values import Array
from aomgen.replacement.mosaic import Photograph, photograph_surface
from aomgen.replacement.old_shadow import shadow_gain
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import contribution_weights
from aomgen.twin.support import SURFACE, Support, cover_from_above, find_support, on_surface
from aomgen.twin.twin import Twin, posed

# Remains of the object are looked for this far around it, [m].
HALO: Final = 0.025
# What the object hid more than all but this share of is not known.
SEEN_SHARE: Final = 0.2
# The surface is made new this far beyond the object's footprint, and reaches as far again under the old one, [m].
MARGIN: Final = 0.03
# So near to the footprint photographs show the object's foot, [m].
FOOT: Final = 0.02
# Where a shadow is so deep that colors would be lifted by more, they are invented, sRGB.
MAX_LIFT: Final = 1.35
# Texture and shadow are judged on a ring this wide, [m].
RING: Final = 0.28
# Cell of the image from above and of the new surface, one Gaussian each, [m].
CELL: Final = 0.004
# New surface lies this far below the old one, so that the old covers it where it is sound, [m].
BELOW: Final = 0.0015
# Cells of the image from above that are covered this much are known.
MIN_ALPHA: Final = 0.6
# Difference of chromaticity from most of the surface that is certainly another thing.
MIN_TINT: Final = 0.07
# Patch side, [px].
PATCH: Final = 25
# Random patches compared at each place; the neighbourhood of the best is searched after.
CANDIDATES: Final = 600
# Structure wider than this [px] is color, finer is texture.
SMOOTHING: Final = 15.0


class Cleared(NamedTuple):
    """A scene without its object.

    Attributes:
        twin: All labels are background or robot; no Gaussian belongs to "object" or "part".
        shadowed: What never moves as it was scanned: the object's shadow on it, nothing made new; world frame.
        support: The plane the object stood on.
        removed: Gaussians taken away beyond those labelled as the object.
        filled: Gaussians of new surface.
    """

    twin: Twin
    shadowed: Gaussians
    support: Support
    removed: int
    filled: int

    @property
    def surroundings(self) -> Gaussians:
        """All that never moves, world frame."""
        return self.twin.scene


def clear_object(
    twin: Twin, robot: RobotModel, views: Sequence[Photograph], rng: np.random.Generator
) -> Cleared:
    """Remove the recorded object from a bound scan.

    Args:
        twin: Bound scan.
        robot: Its robot.
        views: Photographs of the scan: what they saw of the surface is put back, the rest is invented.
        rng: Chooses texture patches.

    Raises:
        ReconstructionError: No supporting plane was scanned.
    """
    world = posed(twin, robot, twin.scan_state)
    of_object = np.isin(twin.labels, (STATIC, MOVING))
    scene = twin.of_scene
    support = find_support(
        world.means[of_object], world.opacities[of_object], world.select(scene), twin.T_world_object
    )
    leftover = scene & (_leftover(world, support) | _hardly_seen(world, of_object, views))
    remaining = twin.select(~of_object & ~leftover)
    table = remaining.of_scene & on_surface(remaining.gaussians, support)
    low, high = support.low - RING, support.high + RING
    extent = cover_from_above(world.select(scene), support, low, high, CELL)
    alpha = cover_from_above(remaining.gaussians.select(table), support, low, high, CELL)
    xy = _cell_centres(low, alpha.shape)
    outside = support.outside(xy)
    photographed = photograph_surface(world, scene, views, support.T_world_plane, xy)
    picture = photographed.colors_srgb
    covered = photographed.seen & (outside > FOOT)
    known = _same_material(picture, covered)
    # What lies close to the footprint and is not the table is the object's: its foot, its mirror image.
    rest = _in_cells(remaining.gaussians, support, low, covered & ~known & (outside < 1.5 * MARGIN)) & table
    remaining, table = remaining.select(~rest), table[~rest]
    gain = shadow_gain(world.select(of_object), support.T_world_plane, low, CELL, picture, known)
    known &= gain.max(-1) < MAX_LIFT
    lightened = _lightened(remaining.gaussians, table, support, low, gain)
    texture = inpaint(np.clip(picture * gain, 0, 1), known, rng)
    # Where nothing was scanned before either, the table ends; gaps within it are closed too.
    thin = (alpha < MIN_ALPHA) & (outside <= 0.7 * RING)
    where = (outside <= 0) | (((outside <= 2 * MARGIN) | thin) & _hull(extent > 0.5))
    fill = _surface(texture, xy, where, support, photographed.gloss_sh)
    cleared = replace(remaining, gaussians=lightened).extended(fill, 0, BACKGROUND)
    return Cleared(
        cleared, remaining.scene, support, removed=int(leftover.sum() + rest.sum()), filled=len(fill)
    )


def _leftover(world: Gaussians, support: Support) -> NDArray[np.bool_]:
    """What of the object was not labelled so: its halo, and the unseen surface beneath it."""
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
    """Which Gaussians (N,) the object hid from nearly all that would see them without it: no photograph shows that they
    are so.
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


def _cell_centres(low: Array, shape: tuple[int, ...]) -> Array:
    """Plane coordinates (H, W, 2) of the cells of an image from above."""
    columns, rows = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    return low + np.stack([columns, rows], -1) * CELL


def _same_material(picture: Array, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Known cells (H, W) that look like most of the surface, lit or in shadow, not like things on it."""
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


def _cells(
    gaussians: Gaussians, support: Support, low: Array, shape: tuple[int, ...]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Column and row (N, 2) of each Gaussian in the image from above, and which are inside it."""
    cells = np.floor((support.coordinates(gaussians.means)[:, :2] - low) / CELL).astype(np.int64)
    return cells, np.asarray(((cells >= 0) & (cells < shape[1::-1])).all(1))


def _in_cells(
    gaussians: Gaussians, support: Support, low: Array, chosen: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    cells, inside = _cells(gaussians, support, low, chosen.shape)
    inside[inside] = chosen[cells[inside, 1], cells[inside, 0]]
    return inside


def _lightened(
    gaussians: Gaussians, table: NDArray[np.bool_], support: Support, low: Array, gain: Array
) -> Gaussians:
    """The table's Gaussians brighter by the gain of their cell."""
    cells, inside = _cells(gaussians, support, low, gain.shape)
    inside &= table
    factor = np.ones((len(gaussians), 3))
    factor[inside] = gain[cells[inside, 1], cells[inside, 0]]
    return gaussians.brightened(factor)


def _surface(
    texture: Array, xy: Array, where: NDArray[np.bool_], support: Support, gloss_sh: Array
) -> Gaussians:
    """Flat Gaussians, one for each cell, with the surface's gloss (K, 3)."""
    places = np.column_stack([xy[where], np.full(int(where.sum()), -BELOW)])
    count = len(places)
    sh = np.tile(gloss_sh, (count, 1, 1))
    sh[:, 0] += (texture[where] - 0.5) / SH_C0
    quat = quat_from_matrix(support.T_world_plane[:3, :3])
    return gaussians_of(
        means=apply(support.T_world_plane, places),
        quats=np.broadcast_to(quat, (count, 4)),
        scales=np.broadcast_to([0.8 * CELL, 0.8 * CELL, 0.1 * CELL], (count, 3)),
        opacities=np.full(count, 0.98),
        sh=sh,
    )


def inpaint(image: Array, known: NDArray[np.bool_], rng: np.random.Generator) -> Array:
    """Complete an image (H, W, 3) where it is not known (H, W); without any known pixel it is grey.

    `rng` chooses candidate patches.
    """
    if not known.any():
        return np.full(image.shape, 0.5)
    smooth = _membrane(_blurred(image, known), known)
    detail = np.where(known[..., None], image - smooth, 0.0)
    texture = _quilted(detail, known, rng)
    return np.where(known[..., None], image, smooth + texture)


def _blurred(image: Array, known: NDArray[np.bool_]) -> Array:
    """Known colors averaged over known neighbours."""
    weight = gaussian_filter(known.astype(float), SMOOTHING)
    masked = np.where(known[..., None], image, 0.0)
    total = np.stack([gaussian_filter(masked[..., k], SMOOTHING) for k in range(3)], -1)
    return total / np.maximum(weight, 1e-6)[..., None]


def _membrane(image: Array, known: NDArray[np.bool_]) -> Array:
    """The smoothest continuation into unknown pixels: Laplace's equation."""
    if known.all():
        return image
    flat = known.ravel()
    laplacian = LaplacianNd(known.shape, boundary_conditions="neumann").tosparse().astype(np.float64)
    rows = laplacian.tocsr()[~flat]
    colors = np.array(image, np.float64).reshape(-1, 3)
    filled = spsolve(rows[:, ~flat].tocsc(), -rows[:, flat] @ colors[flat])
    colors[~flat] = np.asarray(filled).reshape(-1, 3)
    return colors.reshape(image.shape)


def _quilted(detail: Array, known: NDArray[np.bool_], rng: np.random.Generator) -> Array:
    """Texture copied patch by patch from the known part, from the border inwards.

    Source: Efros & Freeman 2001, with soft seams.
    """
    half = PATCH // 2
    result, sure = np.array(detail), known.astype(float)
    whole = np.asarray(sliding_window_view(known, (PATCH, PATCH)).all((2, 3)))
    sources = np.argwhere(whole)
    if not len(sources):
        return result
    windows = np.asarray(sliding_window_view(detail, (PATCH, PATCH, 3)))[:, :, 0]
    inner = np.asarray(distance_transform_edt(~known))
    # Neighbouring patches overlap by more than half.
    grid = np.argwhere(~known)
    grid = grid[(grid % half == 0).all(1)]
    grid = grid[np.argsort(inner[tuple(grid.T)], kind="stable")]
    ramp = 1 - np.abs(np.arange(PATCH) - half) / (half + 1)
    feather = np.minimum.outer(ramp, ramp)
    height, width = known.shape
    for row, column in grid:
        r = int(np.clip(row - half, 0, height - PATCH))
        c = int(np.clip(column - half, 0, width - PATCH))
        box = (slice(r, r + PATCH), slice(c, c + PATCH))
        weight = sure[box]
        tries = sources[rng.integers(0, len(sources), CANDIDATES)]
        best = _closest(windows, tries, result[box], weight)
        around = best + np.argwhere(np.ones((7, 7), bool)) - 3
        inside = ((around >= 0) & (around < whole.shape)).all(1)
        around = around[inside]
        best = _closest(windows, around[whole[tuple(around.T)]], result[box], weight)
        patch = windows[best[0], best[1]]
        # A sharp share: averaging many patches would wash the texture out.
        share = np.where(known[box], 0.0, feather**4 / (feather**4 + weight**4))[..., None]
        result[box] = (1 - share) * result[box] + share * patch
        sure[box] = np.where(known[box], 1.0, np.maximum(weight, feather))
    return result


def _closest(windows: NDArray, places: NDArray[np.int64], target: Array, weight: Array) -> NDArray[np.int64]:
    """The place (2,) whose window (P, P, 3) differs least from the target (P, P, 3)."""
    found = windows[places[:, 0], places[:, 1]]
    difference = (found - target) ** 2
    return places[int(np.argmin(np.einsum("nijk,ij->n", difference, weight)))]
