"""Which Gaussians move with the part: those that the gripper pinches, and those that the video tracks.

Once a motion is found, each Gaussian is asked under which of two stories it explains the pixels that it
covers: it went with the part, or it stood still. Its color is read from the frames at rest; what stands
before it in a frame, robot or part, keeps it out of that frame's verdict.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from aomgen.conventions import MOVING, ROBOT
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.joint import Joint
from aomgen.core.motion import MotionEstimate
from aomgen.core.part_points import SOLID_OPACITY
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.errors import BackendError
from aomgen.io.images import resize
from aomgen.motion.filters import dilate
from aomgen.motion.inputs import MotionInput
from aomgen.robots.robot_masks import MasksAt, robot_masks
from aomgen.splatting.rasterizer import RigidParts, render

# Frames wider than this are reduced, [px].
WIDTH = 640
# Frames that are looked at: at rest, along the way, and at its end.
REST_FRAMES, WAY_FRAMES, END_FRAMES = 9, 9, 4
# The part surely rests this long before its motion, [s].
SETTLED_S = 0.1
# Margin around the robot's masks, and width of the blur against noise and compression, [px].
ROBOT_MARGIN_PX, BLUR_PX = 5, 1.0
# Noise of a pixel's color, 8 bit, compression and slight shading included.
COLOR_SD = 8.0
# How often a pixel shows something that neither story explains: shadows, mirrors, bad labels before it. Odds.
OUTLIERS = 0.1
# Less than this between both places of a Gaussian tells nothing, [px].
MIN_SHIFT_PX = 3.0
# A Gaussian this far behind the drawn surface is hidden, [m].
DEPTH_M = 0.015
# A surface seen at less than this share of its first steepness, or flatter than this cosine, has turned away.
TURNED_SHARE, TURNED_COS = 0.3, 0.15
# Frames err together, by shading that lasts: their mean counts, in full from this many on.
ENOUGH_FRAMES = 4
# Normals are those of planes through so many neighbors.
NORMAL_NEIGHBORS = 16
# Fewer pixels of the moving part do not tell how its light changes.
MIN_PIXELS = 50
# Log odds of what lies between the pads of a gripper that holds the part.
HELD_LOG_ODDS = 4.0


def compute_log_likelihood_ratio(demo: MotionInput, motion: MotionEstimate) -> Array:
    """Natural logarithm (G,) of how much likelier the demonstration is if a Gaussian moves than if it stands.

    Args:
        demo: Video, log, and the scene with its present labels.
        motion: Found with these labels.

    Not checked: that the motion is right. A wrong one moves nothing that looks alike elsewhere.
    """
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        log_ratio = track_log_likelihood_ratio(demo, motion.joint, motion.thetas, motion.start_s, masks_at)
    log_ratio[_held(demo, motion)] += HELD_LOG_ODDS
    log_ratio[demo.labels == ROBOT] = 0.0
    return log_ratio


def _held(demo: MotionInput, motion: MotionEstimate) -> NDArray[np.bool_]:
    """Gaussians (G,) between two pads when the motion begins."""
    if len(demo.robot.pads) != 2:
        return np.zeros(len(demo.scene), bool)
    joints, gripper = demo.log.at([motion.start_s])
    bodies = demo.robot.link_poses(joints, gripper)[0]
    first, second = (bodies[pad.body] @ pad.T_body_pad for pad in demo.robot.pads)
    between = np.ones(len(demo.scene), bool)
    for T_world_pad, other, pad in zip((first, second), (second, first), demo.robot.pads, strict=True):
        local = apply(invert(T_world_pad), demo.scene.means.astype(np.float64))
        gap = float(apply(invert(T_world_pad), other[:3, 3])[2])
        # Along the line to the other pad, and over this one's face.
        share = local[:, 2] / gap if abs(gap) > 1e-6 else np.full(len(local), -1.0)
        between &= (share > 0) & (share < 1) & (np.abs(local[:, :2]) < pad.half_extents[:2]).all(1)
    return between


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rest:
    """The Gaussians as the video shows them at rest.

    Attributes:
        points: (N, 3), world frame; those that are seen.
        pixels: (N, 2).
        colors: (N, 3), 8 bit.
        normals: (N, 3), towards the camera.
        steepness: Cosine (N,) between normal and view.
        moving: Present labels (N,).
    """

    points: Array
    pixels: Array
    colors: Array
    normals: Array
    steepness: Array
    moving: NDArray[np.bool_]


def track_log_likelihood_ratio(
    demo: MotionInput, joint: Joint, thetas: Array, start_s: float, masks_at: MasksAt
) -> Array:
    """As `compute_log_likelihood_ratio` (G,), by the video alone; 0 for what it does not show.

    Args:
        demo: Video, and the scene with its present labels.
        joint: How the part moves.
        thetas: Its values at the video's frames (T,).
        start_s: First moment of the motion, video clock.
        masks_at: Draws the robot.
    """
    width = min(WIDTH, demo.camera.width)
    camera = demo.camera.resized(width, round(width * demo.camera.height / demo.camera.width))
    times = demo.video.times_s
    resting = np.flatnonzero(times < start_s - SETTLED_S)
    result = np.zeros(len(demo.scene))
    if not len(resting):
        return result
    resting = resting[np.unique(np.linspace(0, len(resting) - 1, REST_FRAMES).round().astype(int))]
    frames = _frames_of_the_way(times >= start_s, thetas)
    hidden = _hidden(demo, masks_at, np.concatenate([resting, frames]), camera)
    stands = demo.labels != ROBOT
    scene, moving = demo.scene.select(stands), demo.labels[stands] == MOVING
    seen, rest = _at_rest(
        scene, moving, camera, _median([_frame(demo, k, camera) for k in resting], hidden[: len(resting)])
    )
    total, count = np.zeros(len(rest.points)), np.zeros(len(rest.points))
    for k, robot in zip(frames, hidden[len(resting) :], strict=True):
        T = joint.motion(float(thetas[k]))
        parts = RigidParts(indices=moving.astype(np.int32), Ts_world_part=np.stack([np.eye(4), T]))
        depth = _depth(scene, camera, parts)
        log_ratio = _of_frame(rest, _frame(demo, k, camera), np.where(robot, -1.0, depth), camera, T)
        total += np.nan_to_num(log_ratio)
        count += np.isfinite(log_ratio)
    mean = total / np.maximum(count, 1)
    result[np.flatnonzero(stands)[seen]] = mean * np.minimum(count / ENOUGH_FRAMES, 1)
    return result


def _frames_of_the_way(started: NDArray[np.bool_], thetas: Array) -> NDArray[np.intp]:
    """Frames evenly over the values of the joint (T,), and some after its motion."""
    moving = np.flatnonzero(started)
    values = np.abs(thetas[moving])
    wanted = np.linspace(0.2, 0.9, WAY_FRAMES) * values.max()
    way = [moving[int(np.argmin(np.abs(values - value)))] for value in wanted]
    settled = int(np.argmax(values >= 0.98 * values.max()))
    end = moving[np.linspace(settled, len(moving) - 1, END_FRAMES).astype(int)]
    return np.unique([*way, *end])


def _frame(demo: MotionInput, k: int, camera: Camera) -> NDArray[np.float32]:
    return resize(demo.video.frames_srgb[k], camera.width, camera.height).astype(np.float32)


def _hidden(
    demo: MotionInput, masks_at: MasksAt, frames: NDArray[np.intp], camera: Camera
) -> NDArray[np.bool_]:
    """The robot with a margin (K, H, W)."""
    masks = masks_at(demo.video.times_s[frames], camera.width, camera.height)
    return np.stack([dilate(mask, ROBOT_MARGIN_PX) for mask in masks])


def _median(frames: list[NDArray[np.float32]], hidden: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Median picture (H, W, 3) without the robot; NaN where it always stands."""
    bare = np.where(hidden[..., None], np.nan, np.stack(frames))
    always = hidden.all(0)
    bare[:, always] = 0
    picture = np.nanmedian(bare, axis=0).astype(np.float32)
    picture[always] = np.nan
    return picture


def _at_rest(
    scene: Gaussians, moving: NDArray[np.bool_], camera: Camera, picture: NDArray[np.float32]
) -> tuple[NDArray[np.intp], _Rest]:
    """Indices of the Gaussians that the picture at rest shows, and what they look like there."""
    points = scene.means.astype(np.float64)
    pixels, depths = camera.project(points)
    depth = np.where(np.isnan(picture[..., 0]), -1.0, _depth(scene, camera))
    seen = np.flatnonzero(_shown(pixels, depths, depth))
    normals = _normals(points[seen], points[scene.opacities > SOLID_OPACITY])
    steepness = np.sum(normals * _views(camera, points[seen]), axis=1)
    normals *= np.where(steepness < 0, -1.0, 1.0)[:, None]
    return seen, _Rest(
        points=points[seen],
        pixels=pixels[seen],
        colors=_colors(_blurred(np.nan_to_num(picture)), pixels[seen]),
        normals=normals,
        steepness=np.abs(steepness),
        moving=moving[seen],
    )


def _of_frame(
    rest: _Rest, frame: NDArray[np.float32], depth: NDArray, camera: Camera, T_world_part: Array
) -> Array:
    """Log odds (N,) by one frame; NaN where it does not show both places."""
    places = apply(T_world_part, rest.points)
    pixels, depths = camera.project(places)
    steepness = np.sum((rest.normals @ T_world_part[:3, :3].T) * _views(camera, places), axis=1)
    faces = (steepness > TURNED_SHARE * rest.steepness) & (steepness > TURNED_COS)
    shown_there = faces & _shown(pixels, depths, depth)
    first_depths = camera.project(rest.points)[1]
    shown_here = _shown(rest.pixels, first_depths, depth)
    blurred = _blurred(frame)
    if_moving = _log_likelihood(rest.colors, _colors(blurred, pixels), shown_there & rest.moving)
    if_standing = _log_likelihood(rest.colors, _colors(blurred, rest.pixels), shown_here & ~rest.moving)
    tells = shown_here & shown_there & (np.linalg.norm(pixels - rest.pixels, axis=1) > MIN_SHIFT_PX)
    return np.where(tells, if_moving - if_standing, np.nan)


def _log_likelihood(first: Array, now: Array, which: NDArray[np.bool_]) -> Array:
    """Of colors (N, 3) that were `first` at rest, the light being what some of them (N,) show."""
    gain, offset = _light(first, now, which)
    squared = np.mean((now - gain * first - offset) ** 2, axis=1)
    return np.log(np.exp(-0.5 * squared / COLOR_SD**2) + OUTLIERS)


def _light(first: Array, now: Array, which: NDArray[np.bool_]) -> tuple[float, float]:
    """Gain and offset of colors (N, 3) since they were `first`: exposures change, and light on what turns."""
    if which.sum() < MIN_PIXELS:
        return 1.0, 0.0
    x, y = first[which].ravel(), now[which].ravel()
    gain, offset, weights = 1.0, 0.0, np.ones(len(x))
    for _ in range(8):
        rows = np.stack([x, np.ones(len(x))], 1)
        normal = (rows * weights[:, None]).T @ rows
        # Towards no change, as strongly as one pixel in fifty.
        held = 0.02 * weights.sum() * np.diag(np.array([np.mean(x**2), 1.0]))
        right = (rows * weights[:, None]).T @ y + held @ [1.0, 0.0]
        gain, offset = np.linalg.solve(normal + held, right)
        squared = (y - gain * x - offset) ** 2
        scale = max(float(np.median(squared)), COLOR_SD**2 / 4)
        weights = 1 / (1 + squared / (4 * scale)) ** 2
    return float(gain), float(offset)


def _shown(pixels: Array, depths: Array, depth: NDArray) -> NDArray[np.bool_]:
    """Which points lie in the picture and not behind its surface (H, W); negative depths show nothing."""
    height, width = depth.shape
    inside = (depths > 0) & ((pixels > 2) & (pixels < [width - 2, height - 2])).all(1)
    columns, rows = np.clip(pixels, 0, [width - 1, height - 1]).astype(int).T
    surface = depth[rows, columns]
    return inside & (surface >= 0) & ((surface == 0) | (depths < surface + DEPTH_M))


def _blurred(picture: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Its three channels (H, W) without noise."""
    return [ndimage.gaussian_filter(picture[..., channel], BLUR_PX) for channel in range(3)]


def _colors(planes: list[NDArray[np.float32]], pixels: Array) -> Array:
    """Colors (N, 3) at pixels (N, 2) of three channels (H, W)."""
    at = [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5]
    return np.stack([ndimage.map_coordinates(plane, at, order=1, mode="nearest") for plane in planes], 1)


def _depth(scene: Gaussians, camera: Camera, parts: RigidParts | None = None) -> NDArray[np.float32]:
    """Depth (H, W) of the surface that a camera sees, 0 for none, [m]."""
    depth = render(scene, camera, parts=parts, with_ids=True).median_depth
    if depth is None:
        raise BackendError("rasterizer", "drew no depth", "rebuild the engine")
    return depth


def _normals(points: Array, surface: Array) -> Array:
    """Unit normals (N, 3), either sign, of planes through the nearest surface points."""
    _, nearest = cKDTree(surface).query(points, k=min(NORMAL_NEIGHBORS, len(surface)))
    around = surface[nearest] - surface[nearest].mean(1, keepdims=True)
    return np.asarray(np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0])


def _views(camera: Camera, points: Array) -> Array:
    """Unit directions (N, 3) from points to the camera."""
    offsets = camera.center - points
    return offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
