"""Interior of a drawer: walls and bottom behind its front, which only the demonstration shows.

A scan sees a closed drawer, so that a twin's open front would stand in the air. Walls and bottom move
with the front; those that predict the video best from its other frames are kept, or none.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from aomgen.appearance.surfel_observations import PosedImages
from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate, gaussians_of
from aomgen.core.part_points import surface_points
from aomgen.core.transforms import apply, quat_from_matrix
from aomgen.core.values import Array
from aomgen.errors import BackendError
from aomgen.io.images import resize
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import render
from aomgen.twin.twin import PART, Twin, body_poses, posed_by

# Images are compared in this width, where small errors of the joint value are below a pixel.
WIDTH_PX = 320
# Frames used, at different openings: enough to predict each from the others.
FRAMES = 5
# Share of the travel from which a drawer counts as open: its interior is visible from there.
OPEN_SHARE = 0.4
# Insets of the walls from the outline of the front that are tried, as share of its width.
INSETS = (0.02, 0.06)
# Wall heights tried, as share of the front's height; a few, as the best is chosen by image error.
HEIGHTS = (0.25, 0.5, 0.75, 0.95)
# A tray has to take away this share of the squared error where it may be, or there is none.
MIN_GAIN = 0.3
# Pixels that make a judgement.
MIN_PIXELS = 100
# A drawer's front lies at the end of its body to which it moves, no farther inside than this share of the
# body.
MAX_INSIDE_SHARE = 0.2
# Spacing of discs, [px]: one a pixel leaves no holes.
SPACING_PX = 1.0
# Extent of a disc as share of the spacing, so that neighbours overlap without gaps.
SPREAD = 0.7
# Thickness of a disc as share of the spacing: thin, but not degenerate for the rasterizer.
THICKNESS = 0.05
# Limit on discs, so that a large drawer does not slow down rendering.
MAX_DISCS = 20_000
# Margin around the robot that is not compared, [px]: its contour is uncertain by about this much.
ROBOT_MARGIN_PX = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class _Front:
    """The drawer's front in the part's frame: axes (3, 3) as columns x across, y up, z outward; its extent."""

    axes: Array
    low: Array
    high: Array
    travel_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shot:
    """A frame of an open drawer and what the twin shows of it without a tray."""

    camera: Camera
    T_world_part: Array
    seen_srgb: Array
    drawn_srgb: Array
    drawn_depth: Array
    free: NDArray[np.bool_]


def add_drawer_interior(twin: Twin, robot: RobotModel, view: PosedImages) -> Twin:
    """Add walls and bottom behind the front of a drawer, with colors from the video.

    Args:
        twin: As bound from the scan.
        robot: Its robot.
        view: The demonstration.

    Returns:
        The same twin when the part does not slide out of its body, or when no interior explains the video clearly better.

    Not checked: that the drawer's floor is level with the front's lower edge, and what it holds.
    """
    front = _front(twin, max((state.theta for state in view.states), default=0.0))
    if front is None:
        return twin
    shots = _shots(twin, robot, view, front.travel_m)
    if len(shots) < 3:
        return twin
    spacing = _pixel_size(shots[0], front)
    largest = _ids(_discs(front, INSETS[0], HEIGHTS[-1], spacing), shots)
    regions = [(ids >= 0) & shot.free for ids, shot in zip(largest, shots, strict=True)]
    if not sum(int(region.sum()) for region in regions) >= MIN_PIXELS:
        return twin
    without = _error([shot.drawn_srgb for shot in shots], shots, regions)
    best, best_error = None, (1 - MIN_GAIN) * without
    for inset, height in product(INSETS, HEIGHTS):
        discs = _discs(front, inset, height, spacing)
        ids = _ids(discs, shots)
        error = _error(_predict(discs, ids, shots), shots, regions)
        if error < best_error:
            best, best_error = _color_discs(discs, ids, shots), error
    return twin if best is None else _append(twin, best)


def _front(twin: Twin, travel_m: float) -> _Front | None:
    """None for what is no drawer: parts that turn, slide along their body or into it; level axes only."""
    outward = np.asarray(twin.joint.axis, np.float64)
    up = np.array([0.0, 0.0, 1.0]) - outward[2] * outward
    members, body = (surface_points(twin.gaussians, twin.labels, part) for part in (MOVING, STATIC))
    if twin.joint.type != "prismatic" or not travel_m > 0 or np.linalg.norm(up) < 0.5:
        return None
    if not (len(members) and len(body)):
        return None
    up /= np.linalg.norm(up)
    axes = np.stack([np.cross(up, outward), up, outward], 1)
    low, high = np.quantile(members @ axes, [0.02, 0.98], axis=0)
    back, end = np.quantile(body @ outward, [0.02, 0.98])
    if (low[2] + high[2]) / 2 < end - MAX_INSIDE_SHARE * (end - back):
        return None
    return _Front(axes=axes, low=low, high=high, travel_m=travel_m)


def _shots(twin: Twin, robot: RobotModel, view: PosedImages, travel_m: float) -> list[_Shot]:
    opened = [k for k, state in enumerate(view.states) if state.theta >= OPEN_SHARE * travel_m]
    thetas = np.array([view.states[k].theta for k in opened])
    # Frames of different openings: the same image twice says nothing new.
    wanted = np.linspace(OPEN_SHARE * travel_m, travel_m, FRAMES)
    chosen = sorted({opened[int(np.argmin(np.abs(thetas - value)))] for value in wanted}) if opened else []
    camera = view.camera
    width = min(WIDTH_PX, camera.width)
    small = camera.resized(width, max(1, round(width * camera.height / camera.width)))
    shots = []
    for k in chosen:
        Ts = body_poses(twin, robot, view.states[k])
        arm = (twin.labels == ROBOT)[:, None].astype(np.float32)
        drawn = render(posed_by(twin, Ts), small, features=arm, with_ids=True)
        if drawn.median_depth is None or drawn.features is None:
            raise BackendError("rasterizer", "drew no depth", "rebuild the engine")
        hidden = binary_dilation(drawn.features[..., 0] > 0.2, iterations=ROBOT_MARGIN_PX)
        depth = np.where(drawn.alpha > 0.5, drawn.median_depth, np.inf)
        shots.append(
            _Shot(
                camera=small,
                T_world_part=Ts[twin.body(PART)],
                seen_srgb=resize(view.images_srgb[k], small.width, small.height) / 255.0,
                drawn_srgb=np.asarray(drawn.rgb, np.float64),
                drawn_depth=np.asarray(depth, np.float64),
                free=~hidden,
            )
        )
    return shots


def _pixel_size(shot: _Shot, front: _Front) -> float:
    """Distance between discs, [m]: about a pixel, or more for large trays."""
    middle = apply(shot.T_world_part, (front.axes @ ((front.low + front.high) / 2))[None])
    pixel = float(shot.camera.project(middle)[1][0]) / shot.camera.fx
    width, height = front.high[:2] - front.low[:2]
    area = front.travel_m * (width + 2 * height)
    return max(SPACING_PX * pixel, float(np.sqrt(area / MAX_DISCS)))


def _discs(front: _Front, inset: float, height: float, spacing_m: float) -> Gaussians:
    """Gray discs of both walls and the bottom, part frame."""
    low, high = front.low.copy(), front.high.copy()
    margin = inset * (high[0] - low[0])
    left, right, floor = low[0] + margin, high[0] - margin, low[1] + margin
    top = max(floor + spacing_m, low[1] + height * (high[1] - low[1]))
    z = np.arange(low[2] - front.travel_m, low[2], spacing_m)
    faces = []
    rows = np.arange(floor, top, spacing_m)
    columns = np.arange(left, right, spacing_m)
    for x in (left, right):
        yy, zz = (grid.ravel() for grid in np.meshgrid(rows, z))
        faces.append((np.column_stack([np.full(yy.size, x), yy, zz]), [1, 2, 0]))
    xx, zz = (grid.ravel() for grid in np.meshgrid(columns, z))
    faces.append((np.column_stack([xx, np.full(xx.size, floor), zz]), [2, 0, 1]))
    means = np.concatenate([local for local, _ in faces]) @ front.axes.T
    quats = np.concatenate(
        [np.tile(quat_from_matrix(front.axes[:, order]), (len(local), 1)) for local, order in faces]
    )
    scales = np.array([SPREAD, SPREAD, THICKNESS]) * spacing_m
    count = len(means)
    return gaussians_of(
        means=means.astype(np.float32),
        quats=quats.astype(np.float32),
        scales=np.tile(scales, (count, 1)).astype(np.float32),
        opacities=np.full(count, 0.99, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )


def _ids(discs: Gaussians, shots: Sequence[_Shot]) -> list[NDArray[np.int64]]:
    """Which disc each pixel (H, W) of each shot shows, -1 for none."""
    result = []
    for shot in shots:
        drawn = render(discs.transformed(shot.T_world_part), shot.camera, with_ids=True)
        if drawn.median_depth is None or drawn.max_id is None:
            raise BackendError("rasterizer", "drew no depth", "rebuild the engine")
        shown = (drawn.alpha > 0.5) & (drawn.median_depth < shot.drawn_depth)
        result.append(np.where(shown, drawn.max_id, -1).astype(np.int64))
    return result


def _sums(
    ids: Sequence[NDArray[np.int64]], shots: Sequence[_Shot], count: int
) -> tuple[list[Array], list[Array]]:
    """Sum of colors (N, 3) and number of pixels (N,) of every disc, for each shot."""
    sums, counts = [], []
    for shown, shot in zip(ids, shots, strict=True):
        use = (shown >= 0) & shot.free
        colors = shot.seen_srgb[use]
        sums.append(np.stack([np.bincount(shown[use], colors[:, i], count) for i in range(3)], 1))
        counts.append(np.bincount(shown[use], minlength=count).astype(np.float64))
    return sums, counts


def _mean_colors(discs: Gaussians, totals: Array, pixels: Array) -> Array:
    """Colors (N, 3) of discs; unseen ones take their nearest neighbor's, as a pixel shows several."""
    colors = totals / np.maximum(pixels, 1)[:, None]
    seen = pixels > 0
    if seen.any() and not seen.all():
        colors[~seen] = colors[seen][cKDTree(discs.means[seen]).query(discs.means[~seen])[1]]
    return colors


def _predict(discs: Gaussians, ids: Sequence[NDArray[np.int64]], shots: Sequence[_Shot]) -> list[Array]:
    """Each shot as the others' colors of the tray foretell it."""
    sums, counts = _sums(ids, shots, len(discs))
    total, number = np.sum(sums, axis=0), np.sum(counts, axis=0)
    pictures = []
    for k, (shown, shot) in enumerate(zip(ids, shots, strict=True)):
        colors = _mean_colors(discs, total - sums[k], number - counts[k])
        pictures.append(np.where((shown >= 0)[..., None], colors[shown], shot.drawn_srgb))
    return pictures


def _error(pictures: Sequence[Array], shots: Sequence[_Shot], regions: Sequence[NDArray[np.bool_]]) -> float:
    """Mean squared difference to the video in the regions."""
    squares = [
        np.square(picture - shot.seen_srgb)[region]
        for picture, shot, region in zip(pictures, shots, regions, strict=True)
    ]
    return float(np.concatenate(squares).mean())


def _color_discs(discs: Gaussians, ids: Sequence[NDArray[np.int64]], shots: Sequence[_Shot]) -> Gaussians:
    """Discs in the video's colors."""
    sums, counts = _sums(ids, shots, len(discs))
    colors = _mean_colors(discs, np.sum(sums, axis=0), np.sum(counts, axis=0))
    return discs.with_sh(((colors - 0.5) / SH_C0)[:, None].astype(np.float32))


def _append(twin: Twin, tray: Gaussians) -> Twin:
    """The twin with a tray at its end, so that all indices stay."""
    count = len(tray)
    return replace(
        twin,
        gaussians=concatenate([twin.gaussians, tray.with_sh_degree(twin.gaussians.sh_degree)]),
        bodies=np.concatenate([twin.bodies, np.full(count, twin.body(PART), np.int32)]),
        labels=np.concatenate([twin.labels, np.full(count, MOVING, np.uint8)]),
    )
