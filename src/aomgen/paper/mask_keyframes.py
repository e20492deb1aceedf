"""Masks of the moving part over the video, the paper's motion score, and the frames above its threshold.

The paper segments the part with SAM 2. Without label images, two kinds of pixels are assigned to the part: pixels of
its scanned region whose appearance has not changed, and changed pixels that are connected to this region. This is
less accurate than SAM 2: surfaces that the part uncovers are included, a part with the color of the covered surface
is mistaken for a shadow, and where the part overlaps with its earlier position only its texture shows the motion.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.signal import savgol_filter

from aomgen.capture.label_images import read_demo_masks
from aomgen.conventions import MOVING
from aomgen.core.recording import DemoCamera, Recording
from aomgen.core.robust import compute_masked_median, robust_sd
from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import InputError, NoMotionError
from aomgen.io.images import resize
from aomgen.motion.inputs import MotionInput
from aomgen.motion.keyframes import find_part_region, keep_touching, widen
from aomgen.robots.silhouette import robot_masks

# "printed": the formulas as printed. "threshold": with the noise of the threshold repaired. "repaired": also with the
# signs of the edge cost repaired.
Variant = Literal["printed", "threshold", "repaired"]

# The paper states the filter but not its size; eleven frames and third order are common values.
SMOOTH_FRAMES, SMOOTH_ORDER = 11, 3
# Percentile of the scores that is the paper's B, [%].
BASELINE_PERCENT = 20.0
# Threshold above B in multiples of sigma, as printed.
NOISE_UNITS = 3.0
# Duration of the video whose median is the reference image, which reduces its noise, [s].
REFERENCE_S = 0.25
# Least change, in standard deviations of the noise of a static image, and in 8-bit values (compression noise).
CHANGE_SD, MIN_CHANGE = 6.0, 12.0
# Least share of the light in a shadow.
DARKEST_SHADE = 0.4
# Error of the model's outline at this image size, [px].
ROBOT_MARGIN_PX = 2
# Width of the masks that are computed from changes, [px].
WIDTH = 320


@dataclass(frozen=True, slots=True, kw_only=True)
class PartMasks:
    """Masks of a video segmenter: one of each object in every frame of the demonstration.

    Attributes:
        moving: Visible pixels of the moving part (T, H, W).
        robot: Pixels of the robot (T, H, W).
    """

    moving: Annotated[NDArray[np.bool_], "T H W"]
    robot: Annotated[NDArray[np.bool_], "T H W"]

    __post_init__ = freeze_arrays


def motion_scores(masks: PartMasks) -> Array:
    """Compute the share (T - 1,) of the part's pixels that are not in the mask of the next frame, 0..1.

    The robot's pixels in the other frame are removed from each mask first. If the first mask is empty then, the score
    is 0.

    Raises:
        InputError: Fewer than two frames.

    Source: AOMGen, sec. 4.2, "Keyframe Extraction". As in the paper, a mask that only grows has the score 0.
    """
    if not len(masks.moving) >= 2:
        raise InputError("masks of the demonstration", f"{len(masks.moving)} frames, need 2", "give them all")
    before = masks.moving[:-1] & ~masks.robot[1:]
    after = masks.moving[1:] & ~masks.robot[:-1]
    sizes = before.sum((1, 2))
    return (before & ~after).sum((1, 2)) / np.maximum(sizes, 1)


def smooth_scores(scores: Array) -> Array:
    """Smooth scores (T,) with a Savitzky-Golay filter; a series shorter than the filter is not changed."""
    if len(scores) < SMOOTH_FRAMES:
        return np.array(scores)
    return np.asarray(savgol_filter(scores, SMOOTH_FRAMES, SMOOTH_ORDER))


def score_threshold(scores: Array, smoothed: Array, variant: Variant) -> float:
    """Compute the threshold B + 3 sigma that the score of a moving frame exceeds.

    B is the 20th percentile of the scores (T,). In the variant "printed", sigma is the standard deviation of all
    scores, so a motion raises its own threshold: two levels are separated only if the higher one lasts for less than
    one eighth or for more than seven eighths of the video. In the other variants, sigma is the robust standard
    deviation of the scores about their smoothed values (T,).

    Source: AOMGen, sec. 4.2, "Keyframe Extraction".
    """
    base = float(np.percentile(scores, BASELINE_PERCENT))
    if variant == "printed":
        return base + NOISE_UNITS * float(np.std(scores))
    rough = scores - smoothed
    return base + NOISE_UNITS * robust_sd(rough - np.median(rough))


def flag_frames(smoothed: Array, threshold: float) -> tuple[int, int]:
    """Find the first and the last frame whose smoothed score (T,) exceeds the threshold.

    Raises:
        NoMotionError: No score exceeds the threshold.

    Source: AOMGen, sec. 4.2, "Keyframe Extraction". As in the paper, a single frame above the
    threshold determines an end of the interval, even if it is far from the others.
    """
    flagged = np.flatnonzero(smoothed > threshold)
    if not len(flagged):
        raise NoMotionError(
            "demonstration video",
            "no frame's motion score passes the paper's threshold: the highest is "
            f"{smoothed.max():.4f}, the threshold {threshold:.4f}",
            "use motion_method = 'aomotion'; this threshold grows with the share of moving frames",
        )
    return int(flagged[0]), int(flagged[-1])


def part_masks(capture: Recording, camera: DemoCamera, demo: MotionInput) -> PartMasks:
    """Compute the masks of moving part and robot in every frame.

    The masks of the part are the label images of the capture if there are any, else they are computed from changes in
    the video. The masks of the robot are rendered from its log.

    Raises:
        InputError: See `read_demo_masks`.
    """
    count, height, width = demo.video.frames_srgb.shape[:3]
    labels = read_demo_masks(capture, camera, (count, height, width))
    if labels is None:
        return _masks_by_change(demo)
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        robot = masks_at(demo.video.times_s, width, height)
    return PartMasks(moving=labels == MOVING, robot=robot)


def _masks_by_change(demo: MotionInput) -> PartMasks:
    small = demo.camera.narrow(WIDTH)
    frames = [resize(frame, small.width, small.height) for frame in demo.video.frames_srgb]
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        robot = masks_at(demo.video.times_s, small.width, small.height)
    region = find_part_region(demo.points_moving, small)
    still = max(1, round(REFERENCE_S * demo.video.fps))
    return PartMasks(moving=change_masks(np.stack(frames), robot, region, still), robot=robot)


def change_masks(
    frames_srgb: NDArray[np.uint8], robot: NDArray[np.bool_], region: NDArray[np.bool_], still: int
) -> NDArray[np.bool_]:
    """Compute masks (T, H, W) of a part without the pixels of the robot.

    Args:
        frames_srgb: Small frames (T, H, W, 3).
        robot: The robot's masks (T, H, W) in these frames.
        region: The part's pixels (H, W) at its scanned pose.
        still: Number of frames at the beginning in which only the robot moves.

    Not checked: pixels that the robot occludes in all of these frames are treated as unchanged.
    """
    hidden = widen(robot, ROBOT_MARGIN_PX)
    reference, known = compute_masked_median(frames_srgb[:still], ~hidden[:still])
    masks = np.empty(robot.shape, bool)
    for k, frame in enumerate(frames_srgb):
        compared = known & ~hidden[k]
        changed = compared & _find_changes(frame, reference, compared)
        masks[k] = keep_touching(ndimage.binary_closing(region ^ changed), region) & ~robot[k]
    return masks


def _find_changes(
    frame: NDArray[np.uint8], reference: NDArray[np.float32], compared: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Find pixels (H, W) that differ by more than noise, and not only in brightness."""
    picture = frame.astype(np.float32)
    shade = (picture * reference).sum(-1) / np.maximum((reference**2).sum(-1), 1.0)
    shaded = np.clip(shade, DARKEST_SHADE, 1.0)[..., None] * reference
    difference = np.abs(picture - reference).max(-1)
    noise = robust_sd(difference[compared]) if compared.any() else 0.0
    return np.asarray(np.abs(picture - shaded).max(-1) > max(CHANGE_SD * noise, MIN_CHANGE))
