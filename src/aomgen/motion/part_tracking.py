"""Gaussians that move with the part: those that the gripper pinches, and those that the video tracks.

Each Gaussian is tested for whether it explains its pixels better if it moved with the part or if it
rested. Its color is read from the frames at rest; frames in which robot or part hide it are ignored.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from aomgen.conventions import MOVING, ROBOT
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.joint import Joint
from aomgen.core.motion import MotionEstimate
from aomgen.core.parts import SOLID_OPACITY
from aomgen.core.robust import compute_masked_median, regress_robustly
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.io.images import resize
from aomgen.motion.contact import find_between_pads
from aomgen.motion.inputs import MotionInput
from aomgen.motion.keyframes import widen
from aomgen.motion.part_renderer import sample_resting
from aomgen.motion.photometric import SETTLED_S
from aomgen.robots.silhouette import MasksAt, robot_masks
from aomgen.splatting.rasterizer import RigidParts, render

# Wider frames are reduced to this width, [px].
_WIDTH = 640
# Number of frames used along the path, and at its end.
_WAY_FRAMES, _END_FRAMES = 9, 4
# Margin around the robot's masks, and width of the blur against noise and compression, [px].
_ROBOT_MARGIN_PX, _BLUR_PX = 5, 1.0
# Noise of a pixel's color, 0..1, compression and slight shading included.
_COLOR_SD = 8 / 255
# Likelihood of a color that neither hypothesis explains, such as shadows, mirrors, wrong labels before it.
_OUTLIERS = 0.1
# A Gaussian whose two positions differ by less than this gives no evidence, [px].
_MIN_SHIFT_PX = 3.0
# A Gaussian this far behind the rendered surface is hidden, [m].
_DEPTH_M = 0.015
# A surface has turned away below this share of the cosine of its first viewing angle, or below this cosine.
_TURNED_SHARE, _TURNED_COS = 0.3, 0.15
# Errors of frames are correlated by lasting shading: their mean counts, in full from this many frames on.
_ENOUGH_FRAMES = 4
# Fewer Gaussians do not determine how their light changes.
_MIN_POINTS = 50
# Number of neighbors whose plane defines a normal.
_NEIGHBORS = 16
# Log-likelihood ratio of a Gaussian between the pads of a gripper that holds the part.
_HELD_LOG_ODDS = 4.0


def compute_log_likelihood_ratio(demo: MotionInput, motion: MotionEstimate) -> Array:
    """Compute the log-likelihood ratio (G,), natural logarithm, of a moving over a resting Gaussian.

    `motion`: Estimate made with the present labels.

    Not checked: that the motion is right. With a wrong one, no Gaussian is found to move unless the scene
    looks similar at its moved position.
    """
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        log_ratio = track_log_likelihood_ratio(demo, motion.joint, motion.thetas, motion.start_s, masks_at)
    points = demo.scene.means.astype(np.float64)
    log_ratio[find_between_pads(demo, motion.start_s, points)] += _HELD_LOG_ODDS
    log_ratio[demo.labels == ROBOT] = 0.0
    return log_ratio


def track_log_likelihood_ratio(
    demo: MotionInput, joint: Joint, thetas: Array, start_s: float, masks_at: MasksAt
) -> Array:
    """Compute `compute_log_likelihood_ratio` (G,) from the video alone; 0 for invisible Gaussians.

    Args:
        demo, masks_at: Video, and the scene with its present labels; function that renders the robot's masks.
        joint, thetas: Joint of the part, with values at the video's frames (T,).
        start_s: First moment of the motion, video clock.
    """
    times = demo.video.times_s
    result = np.zeros(len(demo.scene))
    resting = np.flatnonzero(times < start_s - SETTLED_S)
    if not len(resting):
        return result
    resting = sample_resting(resting)
    moved = _choose_frames(times >= start_s, thetas)
    camera = demo.camera.narrow(_WIDTH)

    def read(frames: NDArray[np.intp]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        images = [resize(demo.video.frames_srgb[k], camera.width, camera.height) for k in frames]
        masks = masks_at(times[frames], camera.width, camera.height)
        return np.stack(images), ~widen(masks, _ROBOT_MARGIN_PX)

    stands = np.flatnonzero(demo.labels != ROBOT)
    scene, moving = demo.scene.select(stands), demo.labels[stands] == MOVING
    compare = _compare_with_rest(scene, moving, camera, *read(resting))
    total, count = np.zeros((2, len(stands)))
    for k, image, bare in zip(moved, *read(moved), strict=True):
        log_ratio = compare(image, bare, joint.motion(float(thetas[k])))
        total += np.nan_to_num(log_ratio)
        count += np.isfinite(log_ratio)
    result[stands] = total / np.maximum(count, 1) * np.minimum(count / _ENOUGH_FRAMES, 1)
    return result


def _choose_frames(started: NDArray[np.bool_], thetas: Array) -> NDArray[np.intp]:
    """Choose frames evenly over the values of the joint (T,), and some after its motion."""
    moving = np.flatnonzero(started)
    values = np.abs(thetas[moving])
    wanted = np.linspace(0.2, 0.9, _WAY_FRAMES) * values.max()
    way = np.argmin(np.abs(values - wanted[:, None]), axis=1)
    arrived = int(np.argmax(values >= 0.98 * values.max()))
    end = np.linspace(arrived, len(moving) - 1, _END_FRAMES).astype(int)
    return np.unique(moving[np.concatenate([way, end])])


def _compare_with_rest(
    scene: Gaussians,
    moving: NDArray[np.bool_],
    camera: Camera,
    images: NDArray[np.uint8],
    bare: NDArray[np.bool_],
) -> Callable[[NDArray[np.uint8], NDArray[np.bool_], Array], Array]:
    """Make the comparison of frames with the video at rest, whose colors are the median of some images.

    Args:
        scene, moving: The scene without the robot, and which of its N Gaussians move with the part (N,).
        camera: Camera of all images.
        images, bare: Images at rest (K, H, W, 3), and where they show no robot (K, H, W).

    Returns:
        Function from a frame (H, W, 3), its pixels without robot (H, W) and the part's transform (4, 4) to
        log-likelihood ratios (N,), NaN where the frame does not show both positions.
    """
    points = scene.means.astype(np.float64)
    _, nearest = cKDTree(points[scene.opacities > SOLID_OPACITY]).query(points, k=_NEIGHBORS)
    around = points[scene.opacities > SOLID_OPACITY][nearest]
    around -= around.mean(1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    # Normals point towards the camera.
    normals *= np.where(_steepness(normals, points, camera) < 0, -1.0, 1.0)[:, None]
    _, colors, shown = _look(*compute_masked_median(images, bare), _draw_depth(scene, camera), camera, points)

    def compare(image: NDArray[np.uint8], bare: NDArray[np.bool_], T_world_part: Array) -> Array:
        places = apply(T_world_part, points)
        parts = RigidParts(indices=moving.astype(np.int32), Ts_world_part=np.stack([np.eye(4), T_world_part]))
        depth = _draw_depth(scene, camera, parts)
        pixels_here, colors_here, shown_here = _look(image, bare, depth, camera, points)
        pixels_there, colors_there, shown_there = _look(image, bare, depth, camera, places)
        steepness = _steepness(normals @ T_world_part[:3, :3].T, places, camera)
        faces = steepness > np.maximum(_TURNED_SHARE * _steepness(normals, points, camera), _TURNED_COS)
        shown_here, shown_there = shown_here & shown, shown_there & shown & faces
        if_moving = _log_likelihood(colors, colors_there, shown_there & moving)
        if_standing = _log_likelihood(colors, colors_here, shown_here & ~moving)
        apart = np.linalg.norm(pixels_there - pixels_here, axis=1) > _MIN_SHIFT_PX
        return np.where(shown_here & shown_there & apart, if_moving - if_standing, np.nan)

    return compare


def _look(
    image: NDArray, bare: NDArray[np.bool_], depth: NDArray[np.float32], camera: Camera, points: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Read points (N, 3) in an image (H, W, 3), 8 bit, from its robot-free pixels and depth (H, W).

    Returns:
        Pixels (N, 2), colors (N, 3), 0..1, and visibility (N,) of the points.
    """
    pixels, depths = camera.project(points)
    size = np.array([camera.width, camera.height])
    columns, rows = np.clip(pixels, 0, size - 1).astype(int).T
    surface = depth[rows, columns]
    shown = (depths > 0) & ((pixels > 2) & (pixels < size - 2)).all(1) & bare[rows, columns]
    shown &= (surface == 0) | (depths < surface + _DEPTH_M)
    planes = ndimage.gaussian_filter(image.astype(np.float32) / 255, (_BLUR_PX, _BLUR_PX, 0))
    at = [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5]
    colors = [
        ndimage.map_coordinates(plane, at, order=1, mode="nearest") for plane in np.moveaxis(planes, -1, 0)
    ]
    return pixels, np.stack(colors, 1).astype(np.float64), shown


def _log_likelihood(first: Array, now: Array, which: NDArray[np.bool_]) -> Array:
    """Compute log-likelihoods of colors (N, 3), `first` at rest, with light fitted on some of them (N,)."""
    columns = np.stack([first, np.ones_like(first)], -1)
    change = now - first
    if which.sum() >= _MIN_POINTS:
        light = regress_robustly(columns[which].reshape(-1, 2), change[which].ravel(), _COLOR_SD / 2)[0]
        change = change - columns @ light
    return np.log(np.exp(-0.5 * np.mean(change**2, axis=1) / _COLOR_SD**2) + _OUTLIERS)


def _draw_depth(scene: Gaussians, camera: Camera, parts: RigidParts | None = None) -> NDArray[np.float32]:
    """Render the depth (H, W) of the visible surface, 0 for none, [m]."""
    return np.asarray(render(scene, camera, parts=parts, with_ids=True).median_depth, np.float32)


def _steepness(normals: Array, points: Array, camera: Camera) -> Array:
    """Compute the cosines (N,) between normals and the directions from points to the camera."""
    views = camera.center - points
    return np.sum(normals * views, axis=1) / np.linalg.norm(views, axis=1)
