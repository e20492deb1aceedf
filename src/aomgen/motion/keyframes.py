"""When the part starts and stops moving.

The score of a frame is the share of the part's visible picture that shows neither the part's first
place nor its last one. It rests near zero before the motion and after it, and slow motion adds up
instead of drowning in noise. Every comparison leaves out the robot as it stands in both pictures.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.values import Array
from aomgen.errors import NoMotionError
from aomgen.motion.filters import closed, filled, grown, runs, smooth, touching, without_glitches
from aomgen.motion.hand import Touch


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframeParams:
    """How motion is told from stillness.

    Attributes:
        low_change, high_change: Color differences (8 bit) that surely are no change, and surely are one.
        dilate_px: Margin around the robot's masks, [px].
        reference_s: Length of the still stretches at the beginning and the end of the touch, [s].
        smooth_s: Savitzky-Golay window, [s].
        baseline_percent: Percentile of the still stretches' scores that counts as stillness.
        open_sd, keep_sd: Hysteresis in noise units above the baseline.
        open_share, keep_share: Hysteresis as share of the highest score.
        min_score: Smallest highest score that is a motion.
        min_length_s: Shortest motion, [s].
        merge_gap_s: Pauses shorter than this belong to the motion, [s].
    """

    low_change: float = 14.0
    high_change: float = 40.0
    dilate_px: int = 3
    reference_s: float = 0.25
    smooth_s: float = 0.3
    baseline_percent: float = 20.0
    open_sd: float = 6.0
    keep_sd: float = 3.0
    open_share: float = 0.15
    keep_share: float = 0.05
    min_score: float = 0.03
    min_length_s: float = 0.2
    merge_gap_s: float = 0.7


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """Start and end of the motion with the curve they were read from.

    Attributes:
        first, last: Frame indices of the motion.
        smoothed: Score after smoothing (T,).
        threshold: Score that opens the interval.
    """

    first: int
    last: int
    smoothed: Array
    threshold: float


def part_region(points_world: Array, camera: Camera) -> NDArray[np.bool_]:
    """Pixels (H, W) that the part's points (N, 3) cover, small gaps closed."""
    pixels, depths = camera.project(points_world)
    columns, rows = np.floor(pixels[:, 0]).astype(int), np.floor(pixels[:, 1]).astype(int)
    seen = (depths > 0) & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    region = np.zeros((camera.height, camera.width), bool)
    region[rows[seen], columns[seen]] = True
    return filled(closed(region, 3))


def motion_scores(
    frames_srgb: NDArray[np.uint8],
    robot: NDArray[np.bool_],
    region: NDArray[np.bool_],
    touch: Touch,
    reference_frames: int,
    params: KeyframeParams | None = None,
) -> Array:
    """Score (T,), 0..1, of every frame; 0 outside the touch, where nothing can move the part.

    Args:
        frames_srgb: Small frames (T, H, W, 3).
        robot: The robot's masks (T, H, W) in them.
        region: The part's pixels (H, W) at its scanned place.
        touch: When the hand can move the part. The two states are taken from its ends, so that the
            shadow of the arriving hand is in both pictures.
        reference_frames: Frames that make each of the two pictures.
        params: Thresholds.

    Source: AOMGen, sec. 4.2, "Keyframe Extraction". The paper compares the part's masks in
    neighbouring frames; here the picture itself is compared with the first and the last state.
    """
    params = params or KeyframeParams()
    hidden = np.stack([grown(mask, params.dilate_px) for mask in robot])
    first, last = touch.first, touch.last
    begin, finish = (
        slice(first, first + reference_frames),
        slice(max(first, last + 1 - reference_frames), last + 1),
    )
    before, before_seen = _reference(frames_srgb[begin], hidden[begin])
    after, after_seen = _reference(frames_srgb[finish], hidden[finish])
    moved = before_seen & after_seen & (_change(before, after, params) > 0.5)
    footprint = touching(closed(moved, 1) | region, region)
    left = _departures(frames_srgb, hidden, before, footprint & before_seen, params)
    ahead = _departures(frames_srgb, hidden, after, footprint & after_seen, params)
    scores = np.minimum(left, ahead)
    scores[:first], scores[last + 1 :] = 0.0, 0.0
    return scores


def change_over(
    frames_srgb: NDArray[np.uint8],
    robot: NDArray[np.bool_],
    touch: Touch,
    reference_frames: int,
    params: KeyframeParams,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """How surely pixels changed over the touch (H, W), 0..1, and where both ends show no robot (H, W)."""
    ends = (
        slice(touch.first, touch.first + reference_frames),
        slice(max(touch.first, touch.last + 1 - reference_frames), touch.last + 1),
    )
    pictures = []
    for end in ends:
        hidden = np.stack([grown(mask, params.dilate_px) for mask in robot[end]])
        pictures.append(_reference(frames_srgb[end], hidden))
    (before, before_seen), (after, after_seen) = pictures
    return _change(before, after, params), before_seen & after_seen


def find_interval(
    times_s: Array, scores: Array, touch: Touch, params: KeyframeParams | None = None
) -> Interval:
    """First and last moving frame from a score (T,), during the touch.

    Raises:
        NoMotionError: The score never rises clearly above its stillness.

    Source: AOMGen, sec. 4.2, threshold B + 3 sigma. Repaired: sigma is the robust spread of the
    score about its smooth course (the spread of the scores themselves grows with the motion until
    nothing passes), with hysteresis and a shortest length instead of single flagged frames.
    """
    params = params or KeyframeParams()
    step = float(np.median(np.diff(times_s)))
    smoothed = smooth(without_glitches(scores), step, params.smooth_s)
    first, last = touch.first, touch.last
    count = reference_count(times_s, params)
    still = np.concatenate(
        [smoothed[first : first + count], smoothed[max(first, last + 1 - count) : last + 1]]
    )
    base = float(np.percentile(still, params.baseline_percent))
    rough = (scores - smoothed)[first : last + 1]
    noise = 1.4826 * float(np.median(np.abs(rough - np.median(rough))))
    allowed = np.zeros(len(times_s), bool)
    allowed[first : last + 1] = True
    top = float(smoothed[allowed].max()) - base
    opening = base + max(params.open_sd * noise, params.open_share * top)
    keeping = base + max(params.keep_sd * noise, params.keep_share * top)
    moving = _merge(_hysteresis(smoothed, opening, keeping, allowed), params.merge_gap_s / step)
    moving = [run for run in moving if (run[1] - run[0] + 1) * step >= params.min_length_s]
    if not (moving and top >= params.min_score):
        raise NoMotionError(
            "demonstration video",
            f"the part does not move: its score stays below {smoothed[allowed].max():.3f}, a motion needs "
            f"{max(opening, base + params.min_score):.3f}",
            "check the 'moving' prompts, the camera pose and that the video shows the opening",
        )
    begin, finish = max(moving, key=lambda run: float((smoothed[run[0] : run[1] + 1] - base).sum()))
    return Interval(first=begin, last=finish, smoothed=smoothed, threshold=opening)


def reference_count(times_s: Array, params: KeyframeParams) -> int:
    """Frames in a still stretch, at least two."""
    return max(2, round(params.reference_s / float(np.median(np.diff(times_s)))))


def _reference(
    frames: NDArray[np.uint8], robot: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Median picture (H, W, 3) of the frames without robot, and where there is one (H, W)."""
    bare = np.where(robot[..., None], np.nan, frames.astype(np.float32))
    seen = np.asarray(~robot.all(0))
    bare[:, ~seen] = 0
    return np.nanmedian(bare, axis=0).astype(np.float32), seen


def _change(
    first: NDArray[np.float32], second: NDArray[np.float32], params: KeyframeParams
) -> NDArray[np.float32]:
    """How surely pixels changed (H, W), 0..1."""
    difference = np.abs(first - second).max(-1)
    return np.clip((difference - params.low_change) / (params.high_change - params.low_change), 0, 1)


def _departures(
    frames: NDArray[np.uint8],
    robot: NDArray[np.bool_],
    reference: NDArray[np.float32],
    region: NDArray[np.bool_],
    params: KeyframeParams,
) -> Array:
    """Share (T,) of the region's visible pixels that differ from the reference."""
    shares = np.zeros(len(frames))
    for k, frame in enumerate(frames):
        visible = region & ~robot[k]
        # A sliver that peeks out beside the arm says little: it counts by its size.
        area = max(int(visible.sum()), 0.25 * int(region.sum()), 1)
        shares[k] = float(_change(frame.astype(np.float32), reference, params)[visible].sum()) / area
    return shares


def _hysteresis(
    scores: Array, opening: float, keeping: float, allowed: NDArray[np.bool_]
) -> list[tuple[int, int]]:
    """Runs of frames above `keeping` that somewhere exceed `opening`."""
    stretches = runs((scores > keeping) & allowed)
    return [(int(run[0]), int(run[-1])) for run in stretches if scores[run].max() > opening]


def _merge(runs: list[tuple[int, int]], gap: float) -> list[tuple[int, int]]:
    merged: list[tuple[int, int]] = []
    for run in runs:
        if merged and run[0] - merged[-1][1] <= gap:
            merged[-1] = (merged[-1][0], run[1])
        else:
            merged.append(run)
    return merged
