"""The moving part's masks over the video, the paper's motion score of them, and the frames that its threshold flags.

The paper follows the part with SAM 2. Without label images a pixel counts as the part's when it lies on the
part's scanned location and still looks as it did, or next to it, joined to it, and looks different.
Rougher than SAM 2: what the part uncovered beside itself counts too, a part in the color of what it
covers is taken for its shadow, and where it moved along its own place its texture decides.
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

# "printed": the formulas as they stand. "repaired": with the least change that lets them work.
Variant = Literal["printed", "repaired"]

# The paper names the filter, not its size; eleven frames and third order are its usual ones.
SMOOTH_FRAMES, SMOOTH_ORDER = 11, 3
# Percentile of the scores that is the paper's B, [%].
BASELINE_PERCENT = 20.0
# Sigmas above B at which a frame is flagged, as printed.
NOISE_UNITS = 3.0
# The first image is the median of this duration of video, so that its own noise does not count, [s].
REFERENCE_S = 0.25
# A change is this many standard deviations of the static image's noise, and no less than compression noise, 8 bit.
CHANGE_SD, MIN_CHANGE = 6.0, 12.0
# A shadow leaves at least this share of the light.
DARKEST_SHADE = 0.4
# The model's outline is off by as much at this size, [px].
ROBOT_MARGIN_PX = 2
# Width of the masks by change, [px].
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
    """Share (T - 1,) of the part's pixels that the next frame's mask lost, 0..1.

    From either mask the other frame's robot is subtracted first. Where nothing is left of the first
    mask the score is 0.

    Raises:
        InputError: Fewer than two frames.

    Source: AOMGen, sec. 4.2, "Keyframe Extraction". As there, a mask that only grows scores 0.
    """
    if not len(masks.moving) >= 2:
        raise InputError("masks of the demonstration", f"{len(masks.moving)} frames, need 2", "give them all")
    before = masks.moving[:-1] & ~masks.robot[1:]
    after = masks.moving[1:] & ~masks.robot[:-1]
    sizes = before.sum((1, 2))
    return (before & ~after).sum((1, 2)) / np.maximum(sizes, 1)


def smooth_scores(scores: Array) -> Array:
    """Savitzky-Golay smoothed scores (T,); a series shorter than the filter stays as it is."""
    if len(scores) < SMOOTH_FRAMES:
        return np.array(scores)
    return np.asarray(savgol_filter(scores, SMOOTH_FRAMES, SMOOTH_ORDER))


def score_threshold(scores: Array, smoothed: Array, variant: Variant) -> float:
    """The level B + 3 sigma that a moving frame exceeds.

    B is the 20th percentile of the scores (T,). Printed: sigma is the standard deviation of the scores
    themselves, so that a motion raises its own threshold: two levels are separated only when the
    higher one lasts less than an eighth of the video, or more than seven. Repaired: sigma is the
    robust spread of the scores about their smooth course (T,).

    Source: AOMGen, sec. 4.2, "Keyframe Extraction".
    """
    base = float(np.percentile(scores, BASELINE_PERCENT))
    if variant == "printed":
        return base + NOISE_UNITS * float(np.std(scores))
    rough = scores - smoothed
    return base + NOISE_UNITS * robust_sd(rough - np.median(rough))


def flag_frames(smoothed: Array, threshold: float) -> tuple[int, int]:
    """First and last frame whose smoothed score (T,) exceeds the threshold.

    Raises:
        NoMotionError: No frame does.

    Source: AOMGen, sec. 4.2, "Keyframe Extraction". As there, one flagged frame sets an end of the
    interval, however far from the others it is.
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


def part_masks(capture: Recording, camera: DemoCamera, demonstration: MotionInput) -> PartMasks:
    """Moving part and robot in every frame: the part's from the capture's own label images, else from
    what changed in the video; the robot's drawn from its log.

    Raises:
        InputError: See `read_demo_masks`.
    """
    demo = demonstration
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
    """Masks (T, H, W) of a part, robot left out.

    Args:
        frames_srgb: Small frames (T, H, W, 3).
        robot: The robot's masks (T, H, W) in them.
        region: The part's pixels (H, W) at its scanned place.
        still: Frames at the beginning in which nothing but the robot moves.

    Not checked: what the robot hid in all of these counts as never changed.
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
    """Pixels (H, W) that differ by more than noise, and by more than the brightness of their color."""
    picture = frame.astype(np.float32)
    shade = (picture * reference).sum(-1) / np.maximum((reference**2).sum(-1), 1.0)
    shaded = np.clip(shade, DARKEST_SHADE, 1.0)[..., None] * reference
    difference = np.abs(picture - reference).max(-1)
    noise = robust_sd(difference[compared]) if compared.any() else 0.0
    return np.asarray(np.abs(picture - shaded).max(-1) > max(CHANGE_SD * noise, MIN_CHANGE))
