"""Interval of the motion: position along the gripper's path from the video, time from the joint log.

The change fraction of a frame is the share of the part's visible pixels that differ from its first
appearance, and likewise from its last one. Slow motion accumulates instead of vanishing in noise, and a
reversed motion gives the same curves exchanged. Every comparison excludes the robot in both images. The
motion score, the smaller of the two fractions, is near zero before the motion and after it.
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

# Color differences (8 bit) that are certainly no change (noise, compression), and that certainly are one.
LOW_CHANGE, HIGH_CHANGE = 14.0, 40.0
# Margin around the robot's masks, [px]: at this image size the error of the model's outline is smaller.
ROBOT_MARGIN_PX = 3
# Width of the Savitzky-Golay window, [s].
SMOOTH_S = 0.3
# Smallest noise of a change fraction: video compression makes still images too similar.
LEAST_NOISE = 0.004
# Share of the largest change fraction up to which the image changes in proportion to the gripper's path.
_EARLY = 0.4
# Exponents by which the change fraction grows with the path: in proportion when an edge crosses a plain face,
# slower or faster where the arm uncovers it or a pattern meets another.
_POWERS = (0.7, 1.0, 1.4, 2.0)
# Error of such a curve as a share of the change fraction.
_MISFIT = 0.1
# Path of the gripper within which a part counts as still: half a degree of a door of 0.3 m, and the distance
# by which closing fingers displace the gripper, [m].
STILL_M = 0.0025
# Holding fingers slide or yield by about this much before the part follows, [m].
_SLACK_M = 0.01
# Onsets tried along the path, a hundredth of its length apart.
_CANDIDATES = 101


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangeFractions:
    """Change fractions 0..1 of the part's visible pixels; 0 outside the touch.

    Attributes:
        times_s: Times of the frames (T,), [s].
        touch: Interval in which the gripper can move the part.
        left: Difference from its first appearance (T,).
        ahead: Difference from its last appearance (T,).
    """

    times_s: Array
    touch: TouchInterval
    left: Array
    ahead: Array

    @property
    def scores(self) -> Array:
        """Smaller of both change fractions (T,)."""
        return np.minimum(self.left, self.ahead)

    @property
    def smoothed(self) -> Array:
        """Smoothed scores (T,), without glitches."""
        return smooth(_remove_glitches(self.scores), self._step_s, SMOOTH_S)

    @property
    def noises(self) -> tuple[float, float]:
        """Standard deviations of `left` and `ahead` while the part rests."""
        frames, step = self.touch.frames, self._step_s
        return _measure_noise(self.left[frames], step), _measure_noise(self.ahead[frames], step)

    @property
    def threshold(self) -> float:
        """Score that a resting part hardly ever reaches."""
        return 3.0 * max(self.noises)

    @property
    def _step_s(self) -> float:
        return float(np.median(np.diff(self.times_s)))


def find_part_region(points_world: Array, camera: Camera) -> NDArray[np.bool_]:
    """Find the pixels (H, W) that the part's points (N, 3) cover, with small gaps closed."""
    pixels, depths = camera.project(points_world)
    columns, rows = np.floor(pixels[:, 0]).astype(int), np.floor(pixels[:, 1]).astype(int)
    seen = (depths > 0) & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    region = np.zeros((camera.height, camera.width), bool)
    region[rows[seen], columns[seen]] = True
    return np.asarray(ndimage.binary_fill_holes(ndimage.binary_closing(region, iterations=3)), bool)


def widen(masks: NDArray[np.bool_], margin_px: int = ROBOT_MARGIN_PX) -> NDArray[np.bool_]:
    """Dilate masks (T, H, W) by a margin."""
    cross = ndimage.generate_binary_structure(2, 1)[None]
    return np.asarray(ndimage.binary_dilation(masks, cross, iterations=margin_px), bool)


def keep_touching(mask: NDArray[np.bool_], seed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Keep the connected regions of a mask (H, W), diagonals included, that meet the seed (H, W)."""
    return np.asarray(ndimage.binary_propagation(seed & mask, np.ones((3, 3)), mask), bool)


def measure_change_fractions(
    times_s: Array,
    frames_srgb: NDArray[np.uint8],
    robot: NDArray[np.bool_],
    region: NDArray[np.bool_],
    touch: TouchInterval,
) -> ChangeFractions:
    """Compare every frame of the touch with the two states at its ends.

    Args:
        times_s, frames_srgb, robot: Times (T,) [s] of small frames (T, H, W, 3) of one exposure, and the
            robot's masks (T, H, W) in them.
        region: The part's pixels (H, W) at its scanned pose.
        touch: Interval in which the gripper can move the part. The reference images of the first and last state are taken
            while the gripper is at the part, so that its shadow is in both and does not count as a change.

    Source: AOMGen, sec. 4.2, "Keyframe Extraction". The paper compares the part's masks in
    neighboring frames; here the image itself is compared with the first and the last state.
    """
    frames, hidden = frames_srgb[touch.frames], widen(robot[touch.frames])
    (before, before_seen), (after, after_seen) = _picture_ends(times_s, frames, hidden)
    moved = before_seen & after_seen & (_change(before, after) > 0.5)
    footprint = keep_touching(ndimage.binary_closing(moved) | region, region)
    left, ahead = np.zeros(len(frames_srgb)), np.zeros(len(frames_srgb))
    left[touch.frames] = _compute_change_fractions(frames, hidden, before, footprint & before_seen)
    ahead[touch.frames] = _compute_change_fractions(frames, hidden, after, footprint & after_seen)
    return ChangeFractions(times_s=times_s, touch=touch, left=left, ahead=ahead)


def measure_change(
    times_s: Array, frames_srgb: NDArray[np.uint8], robot: NDArray[np.bool_], touch: TouchInterval
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Measure change per pixel over the touch (H, W), 0..1; also find pixels without robot at both ends."""
    frames, hidden = frames_srgb[touch.frames], widen(robot[touch.frames])
    (before, before_seen), (after, after_seen) = _picture_ends(times_s, frames, hidden)
    return _change(before, after), before_seen & after_seen


def find_interval(seen: ChangeFractions, way: GripperPath, pixel_m: float) -> tuple[float, float]:
    """Find the first and the last moment of the motion, [s].

    Args:
        seen: The part's change fractions.
        way: Path of the gripper, beyond the touch.
        pixel_m: Size of a pixel at the part, [m].

    Source: AOMGen, sec. 4.2, threshold B + 3 sigma. Instead of taking the first and last frame above a
    threshold, the rise and fall of the change fractions are traced back to the noise level; pauses, single
    bad frames and the share of moving frames do not affect the result.
    """
    times, left, ahead = (values[seen.touch.frames] for values in (seen.times_s, seen.left, seen.ahead))
    noise_left, noise_ahead = seen.noises
    during = way.between(float(times[0]), float(times[-1]))
    start_s = detect_onset(during, times, left, noise_left, pixel_m, held=seen.touch.gripped)
    return start_s, detect_offset(during, times, ahead, noise_ahead, pixel_m, held=seen.touch.gripped)


def detect_onset(
    way: GripperPath, times_s: Array, departures: Array, noise: float, pixel_m: float, *, held: bool
) -> float:
    """Estimate when the part leaves its first pose, [s].

    The change fraction is modeled as `k max(0, u - u0)^p` with u the gripper's travel (its path length, if
    not held): 0 while the gripper approaches or slides, then growing. k is fitted, p is summed over, u0 has a
    posterior. A motion of less than a pixel is invisible, so the part moves that much earlier; the result is
    when the gripper gets there.

    Args:
        way: Path of the gripper during the touch.
        times_s: Times of the frames (T,), within those of the path.
        departures: Share (T,) of the part's pixels that differ from its first appearance.
        noise: Standard deviation of a resting part's change fraction.
        pixel_m: Size of a pixel at the part; a shorter motion is invisible, [m].
        held: Fingers hold the part, so that it follows at once or nearly so.
    """
    if len(way.times_s) < 2 or len(times_s) < 2:
        return float(times_s[0])
    clean = _remove_glitches(departures)
    clean = clean - float(np.median(clean[:2]))
    middle = int(np.argmax(clean >= _EARLY * clean.max()))
    early = slice(0, min(max(middle, 2), len(times_s) - 1) + 1)
    # A gripper that holds nothing approaches sideways: its distance from the
    # first position is not the travel.
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
    """Estimate when the part reaches its last pose, [s], as `detect_onset` of the reversed video.

    Args: as in `detect_onset`, but `ahead` (T,): share of the part's pixels that
    differ from its last appearance.
    """
    return -detect_onset(way.reverse(), -times_s[::-1], ahead[::-1], noise, pixel_m, held=held)


def _remove_glitches(values: Array) -> Array:
    """Replace single outliers of a series (T,) by the median of three."""
    return np.asarray(ndimage.median_filter(values, 3, mode="nearest"))


def _measure_noise(values: Array, step_s: float) -> float:
    """Measure the robust standard deviation of a series (T,) about its smooth curve, at least `LEAST_NOISE`."""
    rough = values - smooth(values, step_s, SMOOTH_S)
    return max(LEAST_NOISE, robust_sd(rough - np.median(rough)))


def _picture_ends(
    times_s: Array, frames: NDArray[np.uint8], hidden: NDArray[np.bool_]
) -> list[tuple[NDArray[np.float32], NDArray[np.bool_]]]:
    """Compute median images (H, W, 3) of first and last frames without robot, with valid pixels (H, W).

    `times_s`: Times of all frames of the video.
    """
    # At least three frames of a still segment, so that a bad one does not matter.
    count = max(3, round(REST_S / float(np.median(np.diff(times_s)))))
    return [compute_masked_median(frames[end], ~hidden[end]) for end in (slice(count), slice(-count, None))]


def _change(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute the certainty of a change per pixel (H, W), 0..1."""
    difference = np.abs(first - second).max(-1)
    return np.clip((difference - LOW_CHANGE) / (HIGH_CHANGE - LOW_CHANGE), 0, 1)


def _compute_change_fractions(
    frames: NDArray[np.uint8],
    robot: NDArray[np.bool_],
    reference: NDArray[np.float32],
    region: NDArray[np.bool_],
) -> Array:
    """Compute the share (T,) of the region's visible pixels that differ from the reference."""
    shares = np.zeros(len(frames))
    for k, frame in enumerate(frames):
        visible = region & ~robot[k]
        # A narrow strip that is visible next to the arm is weak evidence: it counts by its size.
        area = max(int(visible.sum()), 0.25 * int(region.sum()), 1)
        shares[k] = float(_change(frame.astype(np.float32), reference)[visible].sum()) / area
    return shares
