"""The scene without its object, its light, and every asset fitted to the motion. [paper 4.3]"""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_closing

from aomgen.assets.choice import open_asset
from aomgen.assets.usd_write import write_for_replay
from aomgen.conventions import MOVING, STATIC
from aomgen.core.camera import Camera, look_at
from aomgen.core.demonstration import EpisodeScene, RecordedObject, SupportPlane
from aomgen.core.episode import NEW_CAMERA
from aomgen.core.gaussians import Gaussians
from aomgen.core.light import Light
from aomgen.core.parts import surface_points
from aomgen.core.plan import FittedAsset, Rejection
from aomgen.core.progress import Progress
from aomgen.core.transforms import angle_between, apply
from aomgen.core.values import Array
from aomgen.errors import EstimationError, ReconstructionError
from aomgen.io.artifact import save_artifact
from aomgen.replacement.correspondence import UP, recorded_contact
from aomgen.replacement.fitting import FitParams, fit_asset
from aomgen.replacement.light_estimation import estimate_light
from aomgen.replacement.obstacles import find_obstacles
from aomgen.replacement.removal import Cleared, clear_object
from aomgen.results import ASSET_USD, ASSETS_FOLDER, FITTED, Results
from aomgen.robots.reach import longest_reach
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import render
from aomgen.splatting.surfels import surfels_of
from aomgen.twin.binding import with_object
from aomgen.twin.support import seen_from_above
from aomgen.twin.twin import Twin, TwinState, posed

# Surfels of an asset, half on each link: one every 7 mm on a surface of 1.5 m2.
SURFELS = 30_000
# How far around the object the table is looked for, and free table grows, [m].
TABLE_REACH_M = 1.0
# Cell of the image in which the table is found, and of the grid on which free table grows, [m]: finer than its
# outline has to be known.
TABLE_CELL_M, FREE_CELL_M = 0.01, 0.02
# A cell with less accumulated alpha than this was not seen.
SURFACE_ALPHA = 0.15
# Holes of this many cells between Gaussians are closed, and a strip of cells counts as free table when no run of
# hidden ones in it is longer.
GAP_CELLS = 3
# Size of the images in which visibility is judged, [px].
LOOK_PX = (160, 120)
# A point is seen when nothing lies nearer than this before it, [m].
CLEARANCE_M = 0.06
# The second camera is turned towards the action by at most this angle [rad], and this share of the key
# points must lie in the image; if no camera can, the second pair holds.
DEMANDS = ((0.35, 0.9), (0.9, 0.6))
# Share of the image's width that the action should span, in its view.
WANTED_SPAN = 0.6
# Folder of the twin without its object.
BACKGROUND_FOLDER = "background"


def run(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Take the object away, fit the project's assets, and choose the cameras of the episodes."""
    project, demo = results.project, results.demonstration
    progress(0.0, "removing the object")
    cleared = clear_object(results.twin, results.robot, np.random.default_rng(project.seed))
    (folder / BACKGROUND_FOLDER).mkdir()
    save_artifact(folder / BACKGROUND_FOLDER, "twin", cleared.twin)
    progress(0.3, "light")
    light = estimate_light(results.twin, results.robot, np.random.default_rng(project.seed))
    support = support_plane(cleared)
    obstacles = find_obstacles(
        cleared.surroundings, cleared.support, longest_reach(results.robot), results.configuration
    )
    moving, static = (
        surface_points(results.scene, results.parts.labels, label) for label in (MOVING, STATIC)
    )
    recorded = RecordedObject(moving_points_world=moving, static_points_world=static, support=support)
    contact = recorded_contact(demo, recorded, results.motion.direction)
    names, residuals = [], []
    params = results.params("replacement", FitParams())
    for index, spec in enumerate(project.assets):
        progress(0.4 + 0.5 * index / len(project.assets), f"asset {spec}")
        fitted = fit_asset(open_asset(spec), contact, demo.joint.type, project.adapt, params)
        if isinstance(fitted, Rejection):
            raise EstimationError(
                f"asset {spec}", fitted.detail, "choose an asset that moves like the recorded object"
            )
        target = folder / ASSETS_FOLDER / f"{index:02d}"
        target.mkdir(parents=True)
        save_artifact(target, FITTED, fitted)
        write_for_replay(fitted.asset, target / ASSET_USD)
        save_artifact(target, "twin", asset_twin(cleared.twin, fitted, light.light, project.seed + index))
        names.append(fitted.asset.name)
        residuals.append(fitted.residual_mm)
    progress(0.9, "new viewpoint")
    scene = EpisodeScene(
        support=support,
        obstacles=obstacles,
        T_world_plane=cleared.support.T_world_plane,
        light=light.light,
        light_source=light.source,
        cameras=episode_cameras(results),
    )
    save_artifact(folder, "scene", scene)
    return {
        "assets": ", ".join(names),
        "light": light.source,
        "removed": cleared.removed,
        "filled": cleared.filled,
        "obstacles": len(obstacles),
        "fit_residual_mm": float(np.max(residuals)) if residuals else 0.0,
    }


def episode_cameras(results: Results) -> dict[str, Camera]:
    """The demonstration's camera and a new viewpoint, at the size of the episodes' images."""
    demo = results.demonstration
    first = results.fixed_camera.camera.resized(*results.project.image_size)
    frames = np.linspace(0, len(demo.times_s) - 1, 4).astype(int)
    held = apply(demo.Ts_world_ee[demo.contact_frames[0]], demo.grasp_ee)
    states = results.states_at(demo.times_s[frames], results.twin.T_world_object)
    key_points = [
        np.stack([demo.Ts_world_ee[t][:3, 3], apply(demo.joint.motion(demo.thetas[t]), held)]) for t in frames
    ]
    side = choose_viewpoint(results.scan_cameras, first, results.twin, results.robot, states, key_points)
    return {results.demo_camera: first, NEW_CAMERA: side}


def choose_viewpoint(
    scan_cameras: Mapping[str, Camera],
    first: Camera,
    twin: Twin,
    robot: RobotModel,
    states: Sequence[TwinState],
    key_points: Sequence[Array],
) -> Camera:
    """Find a camera that sees gripper and object from another side than the first one, whose optics it keeps.

    Args:
        scan_cameras: Registered scan cameras, world frame, by image name.
        states: A few states along the demonstration.
        key_points: What must be seen in each state, for example gripper and handle, (P, 3) each.

    Raises:
        ReconstructionError: There is no scan camera, or none sees the action.
    """
    if not scan_cameras:
        raise ReconstructionError("viewpoint", "no scan camera is registered", "scan the scene again")
    every = np.concatenate(list(key_points))
    scenes = [posed(twin, robot, state) for state in states]
    of_object = np.isin(twin.labels, (STATIC, MOVING))
    framed = np.concatenate([every, *(_corners(scene.means[of_object]) for scene in scenes)])
    target = framed.mean(0)
    for max_turn, share in DEMANDS:
        best, best_score = None, -np.inf
        for name in sorted(scan_cameras):
            camera = first.moved(look_at(scan_cameras[name].center, target))
            if not camera.T_world_cam[:3, 2] @ scan_cameras[name].T_world_cam[:3, 2] > np.cos(max_turn):
                continue
            score = _framing_score(camera, first, framed, share)
            # Seeing everything adds 1; only those are drawn that can still win.
            if score + 1.0 > best_score:
                score += _visible_share(camera.resized(*LOOK_PX), scenes, key_points)
                if score > best_score:
                    best, best_score = camera, score
        if best is not None:
            return best
    raise ReconstructionError(
        "viewpoint", "no scan camera sees the action", "name a camera in the project file"
    )


def _corners(points: ArrayLike) -> Array:
    """Corners (8, 3) of the box around points (N, 3), outliers left out."""
    low, high = np.quantile(np.asarray(points, np.float64), (0.02, 0.98), axis=0)
    return np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 0, low, high)


def _framing_score(camera: Camera, first: Camera, points: Array, share: float) -> float:
    """Score by distance from the first camera's direction and by framing; -inf when it misses the points."""
    small = camera.resized(*LOOK_PX)
    pixels, depths = small.project(points)
    size = np.array(LOOK_PX)
    inside = (depths > 0.3) & ((pixels > 0.06 * size) & (pixels < 0.94 * size)).all(1)
    if not inside.mean() >= share:
        return -np.inf
    span = float(np.ptp(pixels[:, 0])) / LOOK_PX[0]
    # Seen from above.
    angle = angle_between(*((1 - UP) * (eye.center - points.mean(0)) for eye in (camera, first)))
    return float(min(angle / (np.pi / 2), 1.0) * 0.6 - abs(np.log(max(span, 0.01) / WANTED_SPAN)) * 0.4)


def _visible_share(camera: Camera, scenes: list[Gaussians], key_points: Sequence[Array]) -> float:
    """Share of the key points that nothing hides."""
    shares = []
    for scene, points in zip(scenes, key_points, strict=True):
        pixels, depths = camera.project(points)
        u, v = np.clip(pixels, 0, np.array(LOOK_PX) - 1).astype(int).T
        nearest = render(scene, camera).depth[v, u]
        shares.append(((nearest <= 0) | (depths < nearest + CLEARANCE_M)).mean())
    return float(np.mean(shares))


def asset_twin(background: Twin, fitted: FittedAsset, light: Light, seed: int) -> Twin:
    """The cleared scene with a fitted asset where the recorded object stood."""
    rng = np.random.default_rng(seed)
    static, moving = (
        surfels_of(link.meshes, SURFELS // 2, rng) for link in (fitted.asset.static, fitted.asset.moving)
    )
    return with_object(background, static, moving, fitted.asset.joint, light, fitted.T_world_asset)


def support_plane(cleared: Cleared) -> SupportPlane:
    """The table as physics sees it: its height, and the rectangle that is there and free."""
    support = cleared.support
    low, high = support.low - TABLE_REACH_M, support.high + TABLE_REACH_M
    world = cleared.twin.gaussians.select(cleared.twin.bodies == 0)
    _, alpha = seen_from_above(world, support, low, high, TABLE_CELL_M)
    rows, columns = np.nonzero(binary_closing(alpha > SURFACE_ALPHA, iterations=GAP_CELLS))
    xy = low + (np.stack([columns, rows], -1) + 0.5) * TABLE_CELL_M
    xy_corners = [
        [x, y] for x in (support.low[0], support.high[0]) for y in (support.low[1], support.high[1])
    ]

    def in_world(plane_xy: Array) -> Array:
        return apply(support.T_world_plane, np.column_stack([plane_xy, np.zeros(len(plane_xy))]))[:, :2]

    footprint = in_world(np.array(xy_corners))
    free_low, free_high = free_rectangle(in_world(xy), footprint.min(0), footprint.max(0))
    return SupportPlane(height=float(support.T_world_plane[2, 3]), low_xy=free_low, high_xy=free_high)


def free_rectangle(surface_xy: ArrayLike, low: ArrayLike, high: ArrayLike) -> tuple[Array, Array]:
    """Grow a rectangle over the surface around an object, until it meets an edge or another object.

    What stands on the surface hides it, so its cells are empty and stop the growth: the rectangle
    is table that is there and has nothing else on it.

    Args:
        surface_xy: Points of the surface (N, 2), seen from above, [m].
        low, high: Corners (2,) of the object's own footprint, taken as free.
    """
    xy = np.asarray(surface_xy, np.float64)
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    origin = low - TABLE_REACH_M
    shape = np.ceil((high + TABLE_REACH_M - origin) / FREE_CELL_M).astype(int)
    cells = np.floor((xy - origin) / FREE_CELL_M).astype(int)
    inside = np.all((cells >= 0) & (cells < shape), axis=1)
    free = np.zeros(shape, bool)
    free[tuple(cells[inside].T)] = True
    start = np.floor((low - origin) / FREE_CELL_M).astype(int)
    end = np.ceil((high - origin) / FREE_CELL_M).astype(int)
    free[start[0] : end[0], start[1] : end[1]] = True
    growing = True
    while growing:
        growing = False
        for axis, (ends, step) in product((0, 1), ((start, -1), (end, 1))):
            strip = ends[axis] - 1 if step < 0 else ends[axis]
            across = slice(start[1 - axis], end[1 - axis])
            if 0 <= strip < shape[axis] and _longest_gap(free.take(strip, axis)[across]) <= GAP_CELLS:
                ends[axis] += step
                growing = True
    return origin + start * FREE_CELL_M, origin + end * FREE_CELL_M


def _longest_gap(free: NDArray[np.bool_]) -> int:
    """Length of the longest run of cells that are not free."""
    edges = np.flatnonzero(np.concatenate([[True], free, [True]]))
    return int(np.diff(edges).max()) - 1
