"""When the part starts and stops moving: the picture says how far along the hand's way, the hand says when.

A frame's departure from the part's first place is the share of its visible picture that does not show
that place any more; likewise from its last place. Slow motion adds up instead of drowning in noise, and
a motion backwards gives the same curves exchanged. Every comparison leaves out the robot as it stands in
both pictures. The score, the smaller of the two, rests near zero before the motion and after it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aomgen.core.camera import Camera
from aomgen.core.robust import compute_masked_median, robust_sd
from aomgen.core.values import Array
from aomgen.motion.ee_path import GripperPath, smooth
from aomgen.motion.inputs import REST_S, TouchInterval

# Color differences (8 bit): those that surely are no change (noise, compression), and those that surely are one.
LOW_CHANGE, HIGH_CHANGE = 14.0, 40.0
# Margin around the robot's masks, [px]: at this size the model's outline is off by less.
ROBOT_MARGIN_PX = 3
# Width of the Savitzky-Golay window, [s].
SMOOTH_S = 0.3
# Smallest noise of a departure: video compression makes still pictures too equal.
LEAST_NOISE = 0.004
# Share of the largest departure up to which the picture changes in proportion to the hand's way.
_EARLY = 0.4
# How the departure grows with the way: in proportion when an edge crosses a plain face, slower or faster
# where the arm uncovers it or pattern meets pattern.
_POWERS = (0.7, 1.0, 1.4, 2.0)
# What such a curve misses, as a share of the departure.
_MISFIT = 0.1
# Way of the hand within which a part counts as still: half a degree of a door of 0.3 m, and what closing
# fingers push a hand around, [m].
STILL_M = 0.0025
# Fingers that hold slide or give way about this far before the part follows, [m].
_SLACK_M = 0.01
# Onsets tried along the path, a hundredth of its length apart.
_CANDIDATES = 101


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangeFractions:
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
    """Start and end of the motion [s], with the smoothed score (T,), and the deviation of a still part's departures."""

    start_s: float
    end_s: float
    smoothed: Array
    noise: float

    @property
    def threshold(self) -> float:
        """A score that stillness hardly ever reaches."""
        return 3.0 * self.noise


def find_part_region(points_world: Array, camera: Camera) -> NDArray[np.bool_]:
    """Pixels (H, W) that the part's points (N, 3) cover, small gaps closed."""
    pixels, depths = camera.project(points_world)
    columns, rows = np.floor(pixels[:, 0]).astype(int), np.floor(pixels[:, 1]).astype(int)
    seen = (depths > 0) & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    region = np.zeros((camera.height, camera.width), bool)
    region[rows[seen], columns[seen]] = True
    return np.asarray(ndimage.binary_fill_holes(ndimage.binary_closing(region, iterations=3)), bool)


def widen(masks: NDArray[np.bool_], margin_px: int = ROBOT_MARGIN_PX) -> NDArray[np.bool_]:
    """Masks (T, H, W) with a margin."""
    cross = ndimage.generate_binary_structure(2, 1)[None]
    return np.asarray(ndimage.binary_dilation(masks, cross, iterations=margin_px), bool)


def keep_touching(mask: NDArray[np.bool_], seed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Connected regions of a mask (H, W), diagonals included, that meet the seed (H, W)."""
    return np.asarray(ndimage.binary_propagation(seed & mask, np.ones((3, 3)), mask), bool)


def measure_change_fractions(
    frames_srgb: NDArray[np.uint8],
    robot: NDArray[np.bool_],
    region: NDArray[np.bool_],
    touch: TouchInterval,
    reference_frames: int,
) -> ChangeFractions:
    """Compare every frame of the touch with the two states at its ends.

    Args:
        frames_srgb, robot: Small frames (T, H, W, 3) of one exposure, and the robot's masks (T, H, W) in them.
        region: The part's pixels (H, W) at its scanned place.
        touch: When the hand can move the part. The two states are taken from its ends, so that the
            shadow of the arriving hand is in both pictures.
        reference_frames: Frames that make each of the two pictures.

    Source: AOMGen, sec. 4.2, "Keyframe Extraction". The paper compares the part's masks in
    neighbouring frames; here the picture itself is compared with the first and the last state.
    """
    frames, hidden = frames_srgb[touch.frames], widen(robot[touch.frames])
    (before, before_seen), (after, after_seen) = _picture_ends(frames, hidden, reference_frames)
    moved = before_seen & after_seen & (_change(before, after) > 0.5)
    footprint = keep_touching(ndimage.binary_closing(moved) | region, region)
    left, ahead = np.zeros(len(frames_srgb)), np.zeros(len(frames_srgb))
    left[touch.frames] = _compute_change_fractions(frames, hidden, before, footprint & before_seen)
    ahead[touch.frames] = _compute_change_fractions(frames, hidden, after, footprint & after_seen)
    return ChangeFractions(left=left, ahead=ahead)


def measure_change(
    frames_srgb: NDArray[np.uint8],
    robot: NDArray[np.bool_],
    touch: TouchInterval,
    reference_frames: int,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """How surely pixels changed over the touch (H, W), 0..1, and where both ends show no robot (H, W)."""
    hidden = widen(robot[touch.frames])
    (before, before_seen), (after, after_seen) = _picture_ends(
        frames_srgb[touch.frames], hidden, reference_frames
    )
    return _change(before, after), before_seen & after_seen


def find_interval(
    times_s: Array, seen: ChangeFractions, way: GripperPath, touch: TouchInterval, pixel_m: float
) -> Interval:
    """First and last moment of the motion.

    Args:
        times_s, seen: Of the frames (T,), [s], and the part's departures in them.
        way: The hand, over more than the touch.
        touch: When the hand can move the part.
        pixel_m: Size of a pixel at the part, [m].

    Source: AOMGen, sec. 4.2, threshold B + 3 sigma. Instead of the first and last frame above a
    threshold, the departures' rise and fall are followed back to where they come out of the noise;
    pauses, single bad frames and the share of moving frames make no difference to that.
    """
    step = float(np.median(np.diff(times_s)))
    times, left, ahead = (values[touch.frames] for values in (times_s, seen.left, seen.ahead))
    noises = [max(LEAST_NOISE, _measure_noise(values, step)) for values in (left, ahead)]
    held = way.between(float(times[0]), float(times[-1]))
    return Interval(
        start_s=detect_onset(held, times, left, noises[0], pixel_m, held=touch.gripped),
        end_s=detect_offset(held, times, ahead, noises[1], pixel_m, held=touch.gripped),
        smoothed=smooth(_remove_glitches(seen.scores), step, SMOOTH_S),
        noise=max(noises),
    )


def detect_onset(
    way: GripperPath, times_s: Array, departures: Array, noise: float, pixel_m: float, *, held: bool
) -> float:
    """When the part leaves its first place, [s].

    The departure is taken to be `k max(0, u - u0)^p` with u the hand's travel (its way, if not held): 0 while the
    hand comes or slides, then growing with it. k is fitted, p is summed over, u0 has a posterior. Less than a pixel
    does not show, so the part moves that much before; the moment is when the hand gets there.

    Args:
        way: The hand during the touch.
        times_s: Times of the frames (T,), within the way's.
        departures: Share (T,) of the part's picture that does not show its first place.
        noise: Standard deviation of a still part's departure.
        pixel_m: Size of a pixel at the part; a shorter way does not show, [m].
        held: Fingers hold the part, so that it follows at once or nearly so.
    """
    if len(way.times_s) < 2 or len(times_s) < 2:
        return float(times_s[0])
    clean = _remove_glitches(departures)
    clean = clean - float(np.median(clean[:2]))
    middle = int(np.argmax(clean >= _EARLY * clean.max()))
    early = slice(0, min(max(middle, 2), len(times_s) - 1) + 1)
    # A hand that holds nothing comes from aside: its distance from where it was tells nothing.
    travel = way.travel if held else way.length
    along = np.interp(times_s[early], way.times_s, travel)
    offsets = np.linspace(0.0, float(along[-1]), _CANDIDATES)
    slack = np.maximum(0.0, offsets - pixel_m)
    ramps = np.maximum(0.0, along - offsets[:, None]) / max(float(along[-1]), 1e-9)
    curves = np.stack([ramps**power for power in _POWERS])
    weights = 1.0 / (noise**2 + (_MISFIT * clean[early]) ** 2)
    slopes = (curves * weights) @ clean[early] / np.maximum((curves**2 * weights).sum(-1), 1e-12)
    misfit = (weights * (clean[early] - np.maximum(slopes, 0.0)[..., None] * curves) ** 2).sum(-1)
    doubt = misfit / 2 + (slack / _SLACK_M if held else 0.0)
    odds = np.exp(-(doubt - doubt.min())).sum(0)
    odds /= odds.sum()
    passed = np.searchsorted(travel, slack + STILL_M, side="right").clip(max=len(travel) - 1)
    return float(odds @ way.times_s[passed])


def detect_offset(
    way: GripperPath, times_s: Array, ahead: Array, noise: float, pixel_m: float, *, held: bool
) -> float:
    """When the part reaches its last place, [s]: `detect_onset` of the video shown backwards.

    Args: as in `detect_onset`, but `ahead` (T,): the share of the part's picture that does not show its last place.
    """
    return -detect_onset(way.reverse(), -times_s[::-1], ahead[::-1], noise, pixel_m, held=held)


def count_reference_frames(times_s: Array) -> int:
    """Frames in a still stretch, at least three, so that a bad one does not count."""
    return max(3, round(REST_S / float(np.median(np.diff(times_s)))))


def _remove_glitches(values: Array) -> Array:
    """Series (T,) in which single samples that stand out are replaced: the median of three."""
    return np.asarray(ndimage.median_filter(values, 3, mode="nearest"))


def _measure_noise(values: Array, step_s: float) -> float:
    """Robust standard deviation of a series (T,) about its smooth course."""
    rough = values - smooth(values, step_s, SMOOTH_S)
    return robust_sd(rough - np.median(rough))


def _picture_ends(
    frames: NDArray[np.uint8], hidden: NDArray[np.bool_], count: int
) -> list[tuple[NDArray[np.float32], NDArray[np.bool_]]]:
    """Median pictures (H, W, 3) of the first and the last frames without robot, and where there is one (H, W)."""
    return [compute_masked_median(frames[end], ~hidden[end]) for end in (slice(count), slice(-count, None))]


def _change(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """How surely pixels changed (H, W), 0..1."""
    difference = np.abs(first - second).max(-1)
    return np.clip((difference - LOW_CHANGE) / (HIGH_CHANGE - LOW_CHANGE), 0, 1)


def _compute_change_fractions(
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
