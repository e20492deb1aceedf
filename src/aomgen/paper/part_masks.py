"""Masks of the moving part over the demonstration, for the paper's keyframes.

The paper follows the part with SAM 2. Without label images a pixel counts as the part's when it lies on the
part's scanned place and still looks as it did, or beside it, joined to it, and looks different.
Rougher than SAM 2: what the part uncovered beside itself counts too, a part in the color of what it
covers is taken for its shadow, and where it moved along its own place its texture decides.
"""

import numpy as np
from numpy.typing import NDArray

from aomgen.capture.label_images import read_demo_masks
from aomgen.conventions import MOVING
from aomgen.core.recording import Capture, DemoCamera
from aomgen.core.robust import SD_OF_MAD, masked_median
from aomgen.io.images import resize
from aomgen.motion.filters import close_gaps, dilate, keep_touching
from aomgen.motion.inputs import MotionInput
from aomgen.motion.keyframes import find_part_region
from aomgen.paper.mask_keyframes import PartMasks
from aomgen.robots.robot_masks import robot_masks

# The first picture is the median of so much video, so that its own noise does not count, [s].
REFERENCE_S = 0.25
# A change is this many deviations of the still picture's noise, and no less than compression makes, 8 bit.
CHANGE_SD, MIN_CHANGE = 6.0, 12.0
# A shadow leaves at least this share of the light.
DARKEST_SHADE = 0.4
# The model's outline is off by as much at this size, [px].
ROBOT_MARGIN_PX = 2
# Width of the masks by change, [px].
WIDTH = 320


def part_masks(capture: Capture, camera: DemoCamera, demonstration: MotionInput) -> PartMasks:
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
    small = demo.camera.narrowed(WIDTH)
    frames = [resize(frame, small.width, small.height) for frame in demo.video.frames_srgb]
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        robot = masks_at(demo.video.times_s, small.width, small.height)
    region = find_part_region(demo.points_moving, small)
    still = max(1, round(REFERENCE_S * demo.video.fps))
    return PartMasks(moving=changed_masks(np.stack(frames), robot, region, still), robot=robot)


def changed_masks(
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
    hidden = np.stack([dilate(mask, ROBOT_MARGIN_PX) for mask in robot])
    reference, known = masked_median(frames_srgb[:still], ~hidden[:still])
    masks = np.empty(robot.shape, bool)
    for k, frame in enumerate(frames_srgb):
        compared = known & ~hidden[k]
        changed = compared & _changed(frame, reference, compared)
        masks[k] = keep_touching(close_gaps((region & ~changed) | (changed & ~region), 1), region) & ~robot[k]
    return masks


def _changed(
    frame: NDArray[np.uint8], reference: NDArray[np.float32], compared: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Pixels (H, W) that differ by more than noise, and by more than the brightness of their color."""
    picture = frame.astype(np.float32)
    shade = (picture * reference).sum(-1) / np.maximum((reference**2).sum(-1), 1.0)
    shaded = np.clip(shade, DARKEST_SHADE, 1.0)[..., None] * reference
    difference = np.abs(picture - reference).max(-1)
    noise = SD_OF_MAD * float(np.median(difference[compared])) if compared.any() else 0.0
    return np.asarray(np.abs(picture - shaded).max(-1) > max(CHANGE_SD * noise, MIN_CHANGE))
