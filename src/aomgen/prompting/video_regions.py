"""Regions of a demonstration video that change: the robot in the first frame, and what the gripper moves."""

from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aomgen.core.robust import compute_masked_median
from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import NoMotionError
from aomgen.segmentation.interface import Mask, PreparedImage

# Color difference of a pixel that shows something else, above compression and soft shadows, 8 bit.
CHANGED: Final = 25.0
# Side of the window over which differences are averaged, [px]: compression blocks are 8 px.
WINDOW: Final = 5
# An arm that leaves its first position early differs from the first frame in at least this share of the video.
# What it opens later differs for less than that.
LEFT_SHARE: Final = 0.6
# Least size of the robot, as a share of the image.
MIN_ROBOT: Final = 0.005
# Frames that make each of the two images before and after the motion.
PLATE_FRAMES: Final = 24
# Probability that a pixel of a moving, or of a resting part shows something else at the end: inner faces resemble
# outer ones, and shadows move.
MOVED, RESTED = 0.4, 0.05
# Distance between the points that are segmented, and their reach around the contact, as shares of the image's width.
STEP, REACH = 1 / 40, 1 / 8
# Smaller regions are pieces of a part, and larger ones rooms, as shares of the image.
SIZES: Final = (0.002, 0.4)
# A part touches the gripper within this share of the image's width.
NEAR: Final = 1 / 20


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoChange:
    """The scene of a video without the robot, before the motion, and what has changed after it.

    Attributes:
        before_srgb: (H, W, 3) uint8.
        changed: (H, W) pixels that show something else after the motion.
        seen: (H, W) pixels at which no robot hides either state.
    """

    before_srgb: Annotated[NDArray[np.uint8], "H W 3"]
    changed: Annotated[NDArray[np.bool_], "H W"]
    seen: Annotated[NDArray[np.bool_], "H W"]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingRegion:
    """What the gripper moves, in the image before the motion.

    Attributes:
        mask: (H, W).
        confidence: Share of the changed pixels around the contact that it explains, 0..1.
    """

    mask: Annotated[NDArray[np.bool_], "H W"]
    confidence: float

    __post_init__ = freeze_arrays


def find_robot_box(frames_srgb: NDArray[np.uint8]) -> Array:
    """Find the box x0, y0, x1, y1 (4,), [px], of the robot in the first of the frames (T, H, W, 3).

    The base, which does not move, is outside it.

    Raises:
        NoMotionError: Nothing leaves its first position.

    Not checked: that the robot moves first, and that it leaves the region it covers.
    """
    first = frames_srgb[0].astype(np.float32)
    left = np.mean([_differ(frame.astype(np.float32), first) for frame in frames_srgb], axis=0) > LEFT_SHARE
    pieces, count = ndimage.label(left)
    sizes = np.bincount(np.asarray(pieces).ravel(), minlength=2)[1:]
    if not (count and sizes.max() >= MIN_ROBOT * left.size):
        raise NoMotionError(
            "demonstration video",
            f"no robot is seen to move away from where it is in the first frame ({sizes.max() / left.size:.1%} of the "
            f"image, want {MIN_ROBOT:.1%})",
            "mark the parts with `aomgen prompts`",
        )
    rows, columns = np.nonzero(np.asarray(pieces) == 1 + int(np.argmax(sizes)))
    return np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], np.float64)


def compare_states(
    frames_srgb: NDArray[np.uint8], robot: NDArray[np.bool_], first: int, last: int
) -> VideoChange:
    """Compare the scene before a frame with that after another one, without the robot.

    Args:
        frames_srgb, robot: Frames (T, H, W, 3) and the robot's masks (T, H, W) in them.
        first, last: Frames between which the part moves.
    """
    margin = ndimage.generate_binary_structure(2, 1)[None]
    (before, before_seen), (after, after_seen) = (
        compute_masked_median(
            frames_srgb[chosen], ~ndimage.binary_dilation(robot[chosen], margin, iterations=3)
        )
        for chosen in (_spread(0, first + 1), _spread(last, len(frames_srgb)))
    )
    return VideoChange(
        before_srgb=np.where(before_seen[..., None], before, frames_srgb[0]).astype(np.uint8),
        changed=_differ(before, after) & before_seen & after_seen,
        seen=before_seen & after_seen,
    )


def _spread(first: int, end: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(first, end - 1, PLATE_FRAMES).astype(np.int64))


def _differ(a: NDArray[np.float32], b: NDArray[np.float32]) -> Mask:
    return np.asarray(ndimage.uniform_filter(np.abs(a - b).max(2), WINDOW) > CHANGED, bool)


def find_moving_region(image: PreparedImage, change: VideoChange, contact_px: Array) -> MovingRegion:
    """Choose the segment at the contact that the change of the video makes likeliest.

    Args:
        image: `change.before_srgb`, encoded.
        contact_px: Pixel (2,) at which the gripper touches the part.

    Raises:
        NoMotionError: No segment at the contact changes.
    """
    height, width = change.seen.shape
    reach, step = REACH * width, max(4, round(STEP * width))
    offsets = np.arange(-reach, reach + 1, step)
    points = contact_px + np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
    points = points[np.all((points >= 0) & (points < [width, height]), axis=1)]
    found = [mask for mask in image.at_points(points).masks if _fits(mask, contact_px)]
    gains = [_log_likelihood_ratio(mask, change) for mask in found]
    if not (gains and max(gains) > 0):
        raise NoMotionError(
            "demonstration video",
            "nothing at the gripper looks different after it has moved",
            "mark the parts with `aomgen prompts`",
        )
    best = found[int(np.argmax(gains))]
    share = float(change.changed[best].sum() / max(1, change.seen[best].sum()))
    return MovingRegion(mask=best, confidence=min(1.0, share / MOVED))


def _fits(mask: Mask, contact_px: Array) -> bool:
    """Whether a segment has the size of a part, and is at the contact."""
    if not SIZES[0] * mask.size <= mask.sum() <= SIZES[1] * mask.size:
        return False
    rows, columns = np.nonzero(mask)
    nearest = np.hypot(columns + 0.5 - contact_px[0], rows + 0.5 - contact_px[1]).min()
    return bool(nearest <= NEAR * mask.shape[1])


def _log_likelihood_ratio(mask: Mask, change: VideoChange) -> float:
    """Logarithm of the likelihood ratio of a segment that has moved over one that has rested."""
    changed = int((mask & change.changed).sum())
    kept = int((mask & change.seen).sum()) - changed
    return changed * np.log(MOVED / RESTED) + kept * np.log((1 - MOVED) / (1 - RESTED))
