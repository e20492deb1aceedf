"""Interior of a drawer: walls and bottom behind its front, which only the demonstration shows.

A scan shows a closed drawer, so the twin of an open drawer would consist of its front only. Walls and bottom are added that move
with the front: those that predict frames of the video best from the other frames, or none.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera
from aomgen.core.gaussians import SH_C0, Gaussians, gaussians_of
from aomgen.core.parts import surface_points
from aomgen.core.transforms import apply, quat_from_matrix
from aomgen.core.values import Array
from aomgen.io.images import resize
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import render
from aomgen.twin.twin import CONTOUR_PX, PART, PosedImages, TwinModel, body_poses, pose_bodies

# Width of the compared images, [px]: small errors of the joint value are less than a pixel.
WIDTH_PX = 320
# Number of frames at different openings: sufficient to predict each from the others.
FRAMES = 5
# Share of the travel from which a drawer counts as open: its interior is visible from there.
OPEN_SHARE = 0.4
# Tested insets of the walls from the outline of the front, as a share of its width.
INSETS = (0.02, 0.06)
# Tested heights of the walls, as a share of the front's height; the best is chosen by image error, so a few are sufficient.
HEIGHTS = (0.25, 0.5, 0.75, 0.95)
# Least share of the squared error that a tray removes in its region.
MIN_GAIN = 0.3
# Least number of pixels for a decision.
MIN_PIXELS = 100
# Largest distance of the front from the end of the body to which it moves, as a share of the body's depth.
MAX_INSIDE_SHARE = 0.2
# Extent and thickness of a disc as a share of the spacing: neighbors overlap without gaps, and no disc is degenerate.
EXTENT = (0.7, 0.7, 0.05)
# Largest number of discs, so that a large drawer does not slow down rendering; their distance is about one pixel.
MAX_DISCS = 20_000


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


def add_drawer_interior(twin: TwinModel, robot: RobotModel, view: PosedImages) -> TwinModel:
    """Add walls and bottom behind the front of a drawer to a bound scan, with colors from the demonstration.

    The twin is not changed if the part does not slide out of its body, or if no interior explains the video clearly better.

    Not checked: whether the floor of the drawer is level with the lower edge of the front, and the content of the drawer.
    """
    front = _front(twin, max((state.theta for state in view.states), default=0.0))
    if front is None:
        return twin
    shots = _shots(twin, robot, view, front.travel_m)
    if len(shots) < 3:
        return twin
    spacing = _spacing(shots[0], front)
    largest = _discs(front, INSETS[0], HEIGHTS[-1], spacing)
    regions = [(_ids(largest, shot) >= 0) & shot.free for shot in shots]
    if not sum(int(region.sum()) for region in regions) >= MIN_PIXELS:
        return twin
    best, best_error = None, (1 - MIN_GAIN) * _error([shot.drawn_srgb for shot in shots], shots, regions)
    for inset, height in product(INSETS, HEIGHTS):
        discs = _discs(front, inset, height, spacing)
        images, colors = _predict(discs, shots)
        error = _error(images, shots, regions)
        if error < best_error:
            best, best_error = discs.with_sh(((colors - 0.5) / SH_C0)[:, None]), error
    return twin if best is None else twin.extend(best, twin.body(PART), MOVING)


def _front(twin: TwinModel, travel_m: float) -> _Front | None:
    """Describe the front of a drawer; None if the part rotates, slides along or into its body, or has no level axis."""
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


def _shots(twin: TwinModel, robot: RobotModel, view: PosedImages, travel_m: float) -> list[_Shot]:
    opened = [k for k, state in enumerate(view.states) if state.theta >= OPEN_SHARE * travel_m]
    thetas = np.array([view.states[k].theta for k in opened])
    # The frames have different openings, because a repeated image adds no information.
    wanted = np.linspace(OPEN_SHARE * travel_m, travel_m, FRAMES)
    chosen = sorted({opened[int(np.argmin(np.abs(thetas - value)))] for value in wanted}) if opened else []
    small = view.camera.narrow(WIDTH_PX)
    shots = []
    for k in chosen:
        Ts = body_poses(twin, robot, view.states[k])
        arm = (twin.labels == ROBOT)[:, None].astype(np.float32)
        drawn = render(pose_bodies(twin, Ts), small, features=arm, with_ids=True)
        hidden = binary_dilation(np.asarray(drawn.features)[..., 0] > 0.2, iterations=CONTOUR_PX)
        depth = np.where(drawn.alpha > 0.5, np.asarray(drawn.median_depth), np.inf)
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


def _spacing(shot: _Shot, front: _Front) -> float:
    """Compute the distance between discs, [m]: about one pixel, or more for large trays."""
    middle = apply(shot.T_world_part, (front.axes @ ((front.low + front.high) / 2))[None])
    pixel = float(shot.camera.project(middle)[1][0]) / shot.camera.fx
    width, height = front.high[:2] - front.low[:2]
    area = front.travel_m * (width + 2 * height)
    return max(pixel, float(np.sqrt(area / MAX_DISCS)))


def _discs(front: _Front, inset: float, height: float, spacing_m: float) -> Gaussians:
    """Create gray discs on both walls and the bottom, part frame."""
    low, high = front.low, front.high
    margin = inset * (high[0] - low[0])
    left, right, floor = low[0] + margin, high[0] - margin, low[1] + margin
    top = max(floor + spacing_m, low[1] + height * (high[1] - low[1]))
    z = np.arange(low[2] - front.travel_m, low[2], spacing_m)
    rows, columns = np.arange(floor, top, spacing_m), np.arange(left, right, spacing_m)
    walls = [np.stack(np.meshgrid(x, rows, z), -1).reshape(-1, 3) for x in (left, right)]
    bottom = np.stack(np.meshgrid(columns, floor, z), -1).reshape(-1, 3)
    # The columns of the discs' rotations are two axes in the face, then its normal.
    faces = [(walls[0], [1, 2, 0]), (walls[1], [1, 2, 0]), (bottom, [2, 0, 1])]
    quats = [np.tile(quat_from_matrix(front.axes[:, order]), (len(places), 1)) for places, order in faces]
    means = np.concatenate([places for places, _ in faces]) @ front.axes.T
    return gaussians_of(
        means=means,
        quats=np.concatenate(quats),
        scales=np.tile(spacing_m * np.array(EXTENT), (len(means), 1)),
        opacities=np.full(len(means), 0.99),
        sh=np.zeros((len(means), 1, 3)),
    )


def _ids(discs: Gaussians, shot: _Shot) -> NDArray[np.int64]:
    """Render the index of the disc that each pixel (H, W) of a shot shows, -1 for none."""
    drawn = render(discs.transform(shot.T_world_part), shot.camera, with_ids=True)
    shown = (drawn.alpha > 0.5) & (np.asarray(drawn.median_depth) < shot.drawn_depth)
    return np.where(shown, np.asarray(drawn.max_id), -1).astype(np.int64)


def _predict(discs: Gaussians, shots: list[_Shot]) -> tuple[list[Array], Array]:
    """Predict each shot from the tray's colors in the other shots; also return the colors (N, 3) of the discs from all shots."""
    count = len(discs)
    ids = [_ids(discs, shot) for shot in shots]
    sums, pixels = np.zeros((len(shots), count, 3)), np.zeros((len(shots), count))
    for k, (shown, shot) in enumerate(zip(ids, shots, strict=True)):
        use = (shown >= 0) & shot.free
        colors = shot.seen_srgb[use]
        sums[k] = np.stack([np.bincount(shown[use], colors[:, i], count) for i in range(3)], 1)
        pixels[k] = np.bincount(shown[use], minlength=count)
    images = []
    for k, (shown, shot) in enumerate(zip(ids, shots, strict=True)):
        colors = _mean_colors(discs, sums.sum(0) - sums[k], pixels.sum(0) - pixels[k])
        images.append(np.where((shown >= 0)[..., None], colors[shown], shot.drawn_srgb))
    return images, _mean_colors(discs, sums.sum(0), pixels.sum(0))


def _mean_colors(discs: Gaussians, sums: Array, pixels: Array) -> Array:
    """Average the colors (N, 3) of discs; unobserved discs get the color of their nearest neighbor."""
    colors = sums / np.maximum(pixels, 1)[:, None]
    seen = pixels > 0
    if seen.any() and not seen.all():
        colors[~seen] = colors[seen][cKDTree(discs.means[seen]).query(discs.means[~seen])[1]]
    return colors


def _error(images: list[Array], shots: list[_Shot], regions: list[NDArray[np.bool_]]) -> float:
    """Compute the mean squared difference to the video in the regions."""
    squares = [
        np.square(image - shot.seen_srgb)[region]
        for image, shot, region in zip(images, shots, regions, strict=True)
    ]
    return float(np.concatenate(squares).mean())
