"""When the part starts and stops moving.

A frame's departure from the part's first place is the share of its visible picture that does not show
that place any more; likewise from its last place. Slow motion adds up instead of drowning in noise, and
a motion backwards gives the same curves exchanged. Every comparison leaves out the robot as it stands in
both pictures. The score, the smaller of the two, rests near zero before the motion and after it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.robust import robust_sd
from aomgen.core.values import Array
from aomgen.motion.filters import close_gaps, dilate, fill_holes, keep_touching, remove_glitches, smooth
from aomgen.motion.gripper_signals import TouchInterval
from aomgen.motion.onset import GripperPath, detect_offset, detect_onset

# Color differences (8 bit): those that surely are no change (noise, compression), and those that surely are one.
LOW_CHANGE, HIGH_CHANGE = 14.0, 40.0
# Margin around the robot's masks, [px]: at this size the model's outline is off by less.
ROBOT_MARGIN_PX = 3
# Length of the still stretches at the beginning and the end of the touch, [s].
REFERENCE_S = 0.25
# Width of the Savitzky-Golay window, [s].
SMOOTH_S = 0.3
# Smallest noise of a departure: video compression makes still pictures too equal.
LEAST_NOISE = 0.004


@dataclass(frozen=True, slots=True, kw_only=True)
class Departures:
    """Shares 0..1 of the part's picture that show another place; 0 outside the touch.

    Attributes:
        left: Not its first place any more (T,).
        ahead: Not its last place yet (T,).
    """

    left: Array
    ahead: Array

    @property
    def scores(self) -> Array:
        """Share (T,) that shows neither."""
        return np.minimum(self.left, self.ahead)


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """Start and end of the motion with the curve they were read from.

    Attributes:
        start_s, end_s: First and last moment of the motion.
        smoothed: Score after smoothing (T,).
        threshold: Score that stillness hardly ever reaches.
    """

    start_s: float
    end_s: float
    smoothed: Array
    threshold: float


def find_part_region(points_world: Array, camera: Camera) -> NDArray[np.bool_]:
    """Pixels (H, W) that the part's points (N, 3) cover, small gaps closed."""
    pixels, depths = camera.project(points_world)
    columns, rows = np.floor(pixels[:, 0]).astype(int), np.floor(pixels[:, 1]).astype(int)
    seen = (depths > 0) & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    region = np.zeros((camera.height, camera.width), bool)
    region[rows[seen], columns[seen]] = True
    return fill_holes(close_gaps(region, 3))


def measure_departures(
    frames_srgb: NDArray[np.uint8],
    robot: NDArray[np.bool_],
    region: NDArray[np.bool_],
    touch: TouchInterval,
    reference_frames: int,
) -> Departures:
    """Compare every frame of the touch with the two states at its ends.

    Args:
        frames_srgb: Small frames (T, H, W, 3), one exposure.
        robot: The robot's masks (T, H, W) in them.
        region: The part's pixels (H, W) at its scanned place.
        touch: When the hand can move the part. The two states are taken from its ends, so that the
            shadow of the arriving hand is in both pictures.
        reference_frames: Frames that make each of the two pictures.

    Source: AOMGen, sec. 4.2, "Keyframe Extraction". The paper compares the part's masks in
    neighbouring frames; here the picture itself is compared with the first and the last state.
    """
    inside = slice(touch.first, touch.last + 1)
    frames = frames_srgb[inside]
    hidden = np.stack([dilate(mask, ROBOT_MARGIN_PX) for mask in robot[inside]])
    (before, before_seen), (after, after_seen) = _picture_ends(frames, hidden, reference_frames)
    moved = before_seen & after_seen & (_change(before, after) > 0.5)
    footprint = keep_touching(close_gaps(moved, 1) | region, region)
    left, ahead = np.zeros(len(frames_srgb)), np.zeros(len(frames_srgb))
    left[inside] = _departures(frames, hidden, before, footprint & before_seen)
    ahead[inside] = _departures(frames, hidden, after, footprint & after_seen)
    return Departures(left=left, ahead=ahead)


def measure_change(
    frames_srgb: NDArray[np.uint8],
    robot: NDArray[np.bool_],
    touch: TouchInterval,
    reference_frames: int,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """How surely pixels changed over the touch (H, W), 0..1, and where both ends show no robot (H, W)."""
    inside = slice(touch.first, touch.last + 1)
    hidden = np.stack([dilate(mask, ROBOT_MARGIN_PX) for mask in robot[inside]])
    (before, before_seen), (after, after_seen) = _picture_ends(frames_srgb[inside], hidden, reference_frames)
    return _change(before, after), before_seen & after_seen


def find_interval(
    times_s: Array,
    seen: Departures,
    way: GripperPath,
    touch: TouchInterval,
    pixel_m: float,
) -> Interval:
    """First and last moment of the motion.

    Args:
        times_s: Times of the frames (T,), [s].
        seen: The part's departures in them.
        way: The hand, over more than the touch.
        touch: When the hand can move the part.
        pixel_m: Size of a pixel at the part, [m].

    Source: AOMGen, sec. 4.2, threshold B + 3 sigma. Instead of the first and last frame above a
    threshold, the departures' rise and fall are followed back to where they come out of the noise;
    pauses, single bad frames and the share of moving frames make no difference to that.
    """
    step = float(np.median(np.diff(times_s)))
    inside = slice(touch.first, touch.last + 1)
    times = times_s[inside]
    left, ahead = seen.left[inside], seen.ahead[inside]
    noises = [max(LEAST_NOISE, _measure_noise(values, step)) for values in (left, ahead)]
    held = way.between(float(times[0]), float(times[-1]))
    return Interval(
        start_s=detect_onset(held, times, left, noises[0], pixel_m, held=touch.gripped),
        end_s=detect_offset(held, times, ahead, noises[1], pixel_m, held=touch.gripped),
        smoothed=smooth(remove_glitches(seen.scores), step, SMOOTH_S),
        threshold=3.0 * max(noises),
    )


def _measure_noise(values: Array, step_s: float) -> float:
    """Robust standard deviation of a series (T,) about its smooth course."""
    rough = values - smooth(values, step_s, SMOOTH_S)
    return robust_sd(rough - np.median(rough))


def count_reference_frames(times_s: Array) -> int:
    """Frames in a still stretch, at least three, so that a bad one does not count."""
    return max(3, round(REFERENCE_S / float(np.median(np.diff(times_s)))))


def _picture_ends(
    frames: NDArray[np.uint8], robot: NDArray[np.bool_], count: int
) -> list[tuple[NDArray[np.float32], NDArray[np.bool_]]]:
    """Median pictures (H, W, 3) of the first and the last frames without robot, and where there is one (H, W)."""
    pictures = []
    for end in (slice(count), slice(-count, None)):
        bare = np.where(robot[end][..., None], np.nan, frames[end].astype(np.float32))
        seen = np.asarray(~robot[end].all(0))
        bare[:, ~seen] = 0
        pictures.append((np.nanmedian(bare, axis=0).astype(np.float32), seen))
    return pictures


def _change(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """How surely pixels changed (H, W), 0..1."""
    difference = np.abs(first - second).max(-1)
    return np.clip((difference - LOW_CHANGE) / (HIGH_CHANGE - LOW_CHANGE), 0, 1)


def _departures(
    frames: NDArray[np.uint8],
    robot: NDArray[np.bool_],
    reference: NDArray[np.float32],
    region: NDArray[np.bool_],
) -> Array:
    """Share (T,) of the region's visible pixels that differ from the reference."""
    shares = np.zeros(len(frames))
    for k, frame in enumerate(frames):
        visible = region & ~robot[k]
        # A sliver that peeks out beside the arm says little: it counts by its size.
        area = max(int(visible.sum()), 0.25 * int(region.sum()), 1)
        shares[k] = float(_change(frame.astype(np.float32), reference)[visible].sum()) / area
    return shares
