"""Find changing regions of a demonstration video: the robot in the first frame, and the part that it has moved."""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aomgen.core.robust import compute_masked_median
from aomgen.core.values import Array
from aomgen.errors import NoMotionError
from aomgen.segmentation.interface import Mask, PreparedImage, bound_mask

# Color difference of a changed pixel, above the effect of compression and soft shadows, 8 bit.
CHANGED: Final = 25.0
# Side of the window over which differences are averaged, [px]; compression blocks have 8 px.
WINDOW: Final = 5
# Pixels that an arm leaves early differ from the first frame in at least this share of the video; pixels of a part
# that it opens later differ for a shorter time.
LEFT_SHARE: Final = 0.6
# Smallest size of the robot, as a share of the image.
MIN_ROBOT: Final = 0.005
# Number of frames that are combined to the images before and after the motion.
STATE_FRAMES: Final = 24
# Margin around the robot's masks, [px]; before the refinement the outline is accurate to one or two pixels.
ROBOT_MARGIN_PX: Final = 3
# Probability of a change in a pixel that the part newly covers, and in other pixels (moving shadows).
CAME, STAYED = 0.9, 0.1
# Distance between the points that are segmented, and their reach around the gripper, as shares of the image's width.
STEP, REACH = 1 / 40, 1 / 8
# Smallest and largest segment, as shares of the image; smaller ones are pieces of a part, larger ones the room.
SIZES: Final = (0.002, 0.4)
# Largest distance of a part from the gripper that holds it, as a share of the image's width (half a handle's length).
NEAR: Final = 1 / 20
REMEDY: Final = "mark the parts with `aomgen prompts`"


def find_robot_boxes(frames_srgb: NDArray[np.uint8]) -> list[Array]:
    """Find boxes x0, y0, x1, y1 (4,), [px], that may hold the robot in the first of the frames (T, H, W, 3).

    The image border or an object in front of the robot may divide it, and its shadow also moves. Therefore the
    likeliest box contains the largest region that differs from the first frame, and each further box also the next
    region. The base does not move and may be outside.

    Raises:
        NoMotionError: No region leaves its first position.

    Not checked: that the robot moves first, and that it leaves the region that it covers.
    """
    first = frames_srgb[0].astype(np.float32)
    left = np.mean([_differ(frame.astype(np.float32), first) for frame in frames_srgb], axis=0) > LEFT_SHARE
    pieces = np.zeros(left.shape, np.int32)
    ndimage.label(left, output=pieces)
    sizes = np.bincount(pieces.ravel(), minlength=2)
    sizes[0] = 0
    if not sizes.max() >= MIN_ROBOT * left.size:
        raise NoMotionError(
            "demonstration video",
            f"nothing is seen to leave its position in the first frame ({sizes.max() / left.size:.1%} of the image, "
            f"at least {MIN_ROBOT:.1%} is needed)",
            REMEDY,
        )
    order = np.argsort(-sizes)
    large = order[sizes[order] >= MIN_ROBOT * left.size]
    return [
        bound_mask(np.isin(pieces, large[:count])) for count in sorted({1, min(2, len(large)), len(large)})
    ]


def compare_states(
    frames_srgb: NDArray[np.uint8], robot: NDArray[np.bool_], first: int, last: int
) -> tuple[NDArray[np.uint8], Mask, Mask]:
    """Compare the scene before the first frame with that after the last frame of a motion, without the robot.

    Args:
        frames_srgb, robot: Frames (T, H, W, 3) and the robot's masks (T, H, W) in them.
        first, last: First and last frame of the motion.

    Returns:
        Image (H, W, 3) uint8 of the scene after the motion, without the robot where possible; mask (H, W) of the pixels
        that changed; and mask (H, W) of the pixels at which the robot hides neither state.
    """
    cross = ndimage.generate_binary_structure(2, 1)[None]
    (before, before_seen), (after, after_seen) = (
        compute_masked_median(
            frames_srgb[chosen], ~ndimage.binary_dilation(robot[chosen], cross, iterations=ROBOT_MARGIN_PX)
        )
        for chosen in (_spread(0, first + 1), _spread(last, len(frames_srgb)))
    )
    seen = before_seen & after_seen
    after_srgb = np.where(after_seen[..., None], after, frames_srgb[-1]).astype(np.uint8)
    return after_srgb, _differ(before, after) & seen, seen


def _spread(first: int, end: int) -> NDArray[np.int64]:
    """Choose at most `STATE_FRAMES` indices from first to end - 1, evenly spaced."""
    return np.unique(np.linspace(first, end - 1, STATE_FRAMES).astype(np.int64))


def _differ(a: NDArray[np.float32], b: NDArray[np.float32]) -> Mask:
    return np.asarray(ndimage.uniform_filter(np.abs(a - b).max(2), WINDOW) > CHANGED, bool)


def find_moved_region(image: PreparedImage, changed: Mask, seen: Mask, gripper_px: Array) -> Mask:
    """Choose the segment (H, W) at the gripper with the largest likelihood, given the change of the video.

    The part is searched at its final position, where it covers the background; at its initial position, a door may
    reveal an interior as dark as itself.

    Args:
        image: Image after the motion, encoded.
        changed, seen: Masks (H, W), see `compare_states`.
        gripper_px: Pixel (2,) of the end effector after the motion.

    Raises:
        NoMotionError: No segment at the gripper has changed.
    """
    height, width = seen.shape
    offsets = np.arange(-REACH * width, REACH * width + 1, STEP * width)
    points = gripper_px + np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
    points = points[np.all((points >= 0) & (points < [width, height]), axis=1)]
    found = [mask for mask in image.at_points(points).masks if _fits(mask, gripper_px)]
    gains = [_log_likelihood_ratio(mask, changed, seen) for mask in found]
    if not (gains and max(gains) > 0):
        raise NoMotionError(
            "demonstration video", "nothing at the gripper looks different after it has moved", REMEDY
        )
    return found[int(np.argmax(gains))]


def _fits(mask: Mask, gripper_px: Array) -> bool:
    """Return whether a segment has the size of a part and is near the gripper."""
    if not SIZES[0] * mask.size <= mask.sum() <= SIZES[1] * mask.size:
        return False
    rows, columns = np.nonzero(mask)
    nearest = np.hypot(columns + 0.5 - gripper_px[0], rows + 0.5 - gripper_px[1]).min()
    return bool(nearest <= NEAR * mask.shape[1])


def _log_likelihood_ratio(mask: Mask, changed: Mask, seen: Mask) -> float:
    """Compute the log-likelihood ratio of the hypotheses that a segment is the moved part and that it is unchanged."""
    differ = int((mask & changed).sum())
    same = int((mask & seen).sum()) - differ
    return float(differ * np.log(CAME / STAYED) + same * np.log((1 - CAME) / (1 - STAYED)))
