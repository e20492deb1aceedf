"""The offset between the video's clock and the joint log's clock, from silhouettes alone.

If the robot model, posed by the log, covers a pixel at only one of two times, the video changes at this pixel between these times;
if it covers the pixel at neither, the video should not change. The estimate is the most likely offset, first on a grid over all
possible offsets and drifts, then in steps of a fraction of a frame. Only changes are compared, so a small error of the camera pose
has little influence; a common shift of the silhouettes compensates it. `bundle_adjustment` continues from here.
"""

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from aomgen.core.alignment import Clock
from aomgen.core.least_squares import jackknife_covariance
from aomgen.core.robust import robust_sd
from aomgen.core.values import Array
from aomgen.errors import SyncError
from aomgen.io.images import resize
from aomgen.io.video import Video
from aomgen.robots.silhouette import MasksAt

# Lags between compared frames, in coarse steps, for fast, medium and slow motions of an arm.
LAGS = (1, 3, 8)
# Least share of the video that the log covers.
MIN_OVERLAP = 0.5
# Largest image width for the comparison, [px]: a link is a few pixels wide.
WIDTH = 160
# Coarse step, which is also the interval between frames, [s].
STEP_S = 0.1
# Number of fine steps in one coarse step, 25 ms each: less than a frame; a parabola interpolates between them.
FINE_STEPS = 4
# Frame pairs used for the fine search.
FINE_PAIRS = 14
# Silhouette shifts tried along x and y in the fine search, [px]: the error of an unrefined camera pose.
SHIFTS_PX = (-4, -2, 0, 2, 4)
# Probability of a change where silhouettes differ; less than 1, because robot and background may have similar colors.
CHANGE_LIKELIHOOD = 0.6
# Largest score of another offset, as a share of the best one; beyond it, the offset is ambiguous.
MAX_RIVAL = 0.85
# Least distance of another offset from the best one, [s]: more than the width of its peak.
RIVAL_DISTANCE_S = 0.5
# Largest clock drift among the hypotheses, [s/s]: more than that of a 25 fps video that is labeled as 24 fps (0.04).
MAX_RATE = 0.06
# Least share of the image by which the silhouette changes between two frames: more than compression noise.
MIN_CHANGE = 0.003
# Least difference between the best score and the mean of the others, in standard deviations of these.
MIN_GAIN_SD = 2.0
# Segments of time left out in turn for the standard deviation (jackknife).
_BLOCKS = 5
# Least standard deviation of a clock, [s]: time stamps are rounded to a millisecond.
MIN_CLOCK_SD_S = 0.001


class ClockFrames:
    """Small frames of a video at nearly equal steps, and the noise between two of them."""

    def __init__(self, video: Video) -> None:
        # For videos with a variable rate, the frame nearest to each of evenly spaced times is used.
        stride = max(1, round(STEP_S * video.fps))
        even = np.arange(video.times_s[0], video.times_s[-1] + 0.5 / video.fps, stride / video.fps)
        chosen = np.abs(video.times_s - even[:, None]).argmin(1)
        height, width = video.frames_srgb.shape[1:3]
        small = min(WIDTH, width)
        size = (small, max(1, round(small * height / width)))
        images = np.stack([resize(frame, *size) for frame in video.frames_srgb[chosen]]).astype(np.float32)
        if not len(images) > max(LAGS):
            raise SyncError("video", f"has only {len(images)} frames to compare", "record the whole motion")
        self.images, self.size, self.times_s = images, size, video.times_s[chosen]
        self.step_s = float((self.times_s[-1] - self.times_s[0]) / (len(self.times_s) - 1))
        self.middle_s = float(self.times_s[0] + self.times_s[-1]) / 2
        self._noise = max(robust_sd(np.diff(images, axis=0)), 0.5)

    def change(self, first: int, second: int) -> NDArray[np.float32]:
        """Compute the confidence (P,), 0..1, that a pixel changed; a change of the overall brightness is ignored."""
        difference = self.images[second] - self.images[first]
        difference = difference - np.median(difference, axis=(0, 1))
        strength = np.abs(difference).max(-1).ravel()
        low = 4 * self._noise + 4
        return np.clip((strength - low) / (2 * low), 0, 1)


def change_gains(changes: NDArray[np.float32]) -> tuple[NDArray, NDArray]:
    """Compute log-likelihood gains (K, P) of "the silhouettes differ here" and of "no robot at either time"."""
    usual = float(np.clip(changes.mean(), 1e-3, 0.5 * CHANGE_LIKELIHOOD))
    still = usual / 2

    def gain(probability: float) -> NDArray[np.float32]:
        return changes * np.log(probability / usual) + (1 - changes) * np.log((1 - probability) / (1 - usual))

    return gain(CHANGE_LIKELIHOOD), gain(still)


def estimate_clock(video: Video, log_times_s: Array, masks_at: MasksAt) -> Clock:
    """Find the offset, and roughly the drift, from the motion of the arm.

    Args:
        log_times_s: Times of the joint log (T,), clock of the log, [s].
        masks_at: Renders masks of the robot at log times.

    Returns:
        The clock; the error of its drift is at most half the step between the tested drifts.

    Raises:
        SyncError: The log does not cover enough of the video under any offset, the arm does not move or is out of view, or
            two offsets explain the video equally well.

    Not checked: a drift that changes during the demonstration.
    """
    frames = ClockFrames(video)
    grid = np.arange(log_times_s[0], log_times_s[-1], frames.step_s, dtype=np.float64)
    tables = _coarse_tables(frames, grid, masks_at)
    rates, candidates, scores = _coarse_scores(frames, tables, grid)
    none, best = len(rates) // 2, int(np.argmax(scores.max(1)))
    _refuse_ambiguous(candidates, scores[best])
    found = [
        _fine(frames, _guess(frames, rates, candidates, scores, row), log_times_s, masks_at)
        for row in sorted({none, best})
    ]
    return max(found, key=lambda item: item[1])[0]


def _coarse_tables(frames: ClockFrames, grid: Array, masks_at: MasksAt) -> list[Array]:
    """Compute for each lag the score (K, M) of video frame k and the frame after the lag at grid time m, log clock."""
    if not len(grid) > max(LAGS):
        raise SyncError(
            "joint log",
            f"spans {len(grid) * frames.step_s:.1f} s, too short for a video of "
            f"{len(frames.images) * frames.step_s:.1f} s",
            "export the log of the whole demonstration",
        )
    masks = masks_at(grid, *frames.size).reshape(len(grid), -1)
    moved = max(float((masks[:-lag] ^ masks[lag:]).mean(1).max()) for lag in LAGS)
    if not moved >= MIN_CHANGE:
        raise SyncError(
            "clock offset",
            f"the arm stands still in the joint log or moves out of view: its silhouette changes by at most "
            f"{moved:.2%} of the image, at least {MIN_CHANGE:.1%} are needed",
            "record a demonstration in view of this camera, or state clock_offset_s",
        )
    tables = []
    for lag in LAGS:
        changes = np.stack([frames.change(k, k + lag) for k in range(len(frames.images) - lag)])
        differ, still = change_gains(changes)
        first, second = masks[:-lag], masks[lag:]
        apart, away = first ^ second, ~(first | second)
        tables.append(differ @ apart.astype(np.float32).T + still @ away.astype(np.float32).T)
    return tables


def _coarse_scores(frames: ClockFrames, tables: list[Array], grid: Array) -> tuple[Array, Array, Array]:
    """Compute drifts (R,), offsets at the middle of the video (C,), and the score (R, C) of each pair of them.

    Frame pairs that the log does not cover do not change the score.
    """
    count, size = len(frames.images), len(grid)
    need = int(np.ceil(MIN_OVERLAP * count))
    shifts = np.arange(need - count, size - need + 1)
    # One step of drift moves the ends of the video by half a step of time.
    half = int(np.ceil(MAX_RATE * count))
    rates = np.arange(-half, half + 1) / count
    scores = np.zeros((len(rates), len(shifts)))
    for row, rate in enumerate(rates):
        for table in tables:
            k = np.arange(len(table))
            places = np.round(k + rate * (k - (count - 1) / 2)).astype(int)[:, None] + shifts
            inside = (places >= 0) & (places < table.shape[1])
            scores[row] += (table[k[:, None], places.clip(0, table.shape[1] - 1)] * inside).sum(0)
    return rates, grid[0] + shifts * frames.step_s - frames.times_s[0], scores


def _guess(frames: ClockFrames, rates: Array, candidates: Array, scores: Array, row: int) -> Clock:
    """Select the best clock for one drift (row of the scores)."""
    best = int(np.argmax(scores[row]))
    nearby = slice(max(0, best - 1), best + 2)
    return Clock(
        offset_s=_vertex(candidates[nearby], scores[row, nearby]),
        rate=float(rates[row]),
        rate_sd=float(rates[1] - rates[0]) / 2,
        middle_s=frames.middle_s,
    )


def _refuse_ambiguous(candidates: Array, scores: Array) -> None:
    best = int(np.argmax(scores))
    base = float(np.median(scores))
    spread = robust_sd(scores - base)
    gain = float(scores[best]) - base
    if not gain > MIN_GAIN_SD * max(spread, 1e-9):
        raise SyncError(
            "clock offset",
            f"no offset fits clearly better than the others (best {gain:.0f} over a spread of {spread:.0f})",
            "check the camera pose, or state clock_offset_s",
        )
    far = np.abs(candidates - candidates[best]) > RIVAL_DISTANCE_S
    rival = float(scores[far].max() - base) / gain if far.any() else 0.0
    if not rival < MAX_RIVAL:
        other = candidates[far][int(np.argmax(scores[far]))]
        raise SyncError(
            "clock offset",
            f"{candidates[best]:.2f} s and {other:.2f} s explain the video nearly equally well "
            f"({rival:.0%}, limit {MAX_RIVAL:.0%})",
            "state clock_offset_s",
        )


def _fine(frames: ClockFrames, guess: Clock, log_times_s: Array, masks_at: MasksAt) -> tuple[Clock, float]:
    """Refine a clock's offset between grid points with pairs spread over the motion; also return its score."""
    pairs = _telling_pairs(frames, guess, log_times_s)
    weights = change_gains(np.stack([frames.change(*pair) for pair in pairs]))
    offsets = guess.offset_s + np.arange(-FINE_STEPS, FINE_STEPS + 1) * frames.step_s / FINE_STEPS
    clocks = [replace(guess, offset_s=float(offset)) for offset in offsets]
    table = np.stack([_fine_scores(frames, pairs, weights, clock, masks_at) for clock in clocks], 1)
    best = _vertex(offsets, table.sum(0).max(1))
    blocks = np.array_split(np.arange(len(pairs)), min(_BLOCKS, len(pairs)))
    left_out = np.array([_vertex(offsets, np.delete(table, block, 0).sum(0).max(1)) for block in blocks])
    # Jackknife over segments of time, because the error of the camera pose is correlated within a segment.
    sd = float(np.sqrt(jackknife_covariance(left_out[:, None])[0, 0]))
    return replace(guess, offset_s=best, sd_s=max(sd, MIN_CLOCK_SD_S)), float(table.sum(0).max())


def _fine_scores(
    frames: ClockFrames,
    pairs: list[tuple[int, int]],
    weights: tuple[NDArray, NDArray],
    clock: Clock,
    masks_at: MasksAt,
) -> Array:
    """Score (K, S) of each pair under each shift of the silhouettes."""
    moments = sorted({k for pair in pairs for k in pair})
    row = {k: i for i, k in enumerate(moments)}
    masks = masks_at(clock.log_times(frames.times_s[moments]), *frames.size)
    first, second = masks[[row[k] for k, _ in pairs]], masks[[row[k] for _, k in pairs]]
    apart, away = first ^ second, ~(first | second)
    differ, still = weights
    scores = []
    for shift in product(SHIFTS_PX, repeat=2):
        moved = [np.roll(part, shift, (1, 2)).reshape(len(pairs), -1) for part in (apart, away)]
        scores.append((differ * moved[0] + still * moved[1]).sum(1))
    return np.stack(scores, 1)


def _telling_pairs(frames: ClockFrames, clock: Clock, log_times_s: Array) -> list[tuple[int, int]]:
    """Select pairs of frames to compare, spread evenly over the motion."""
    lag = LAGS[len(LAGS) // 2]
    moments = clock.log_times(frames.times_s)
    covered = [
        k
        for k in range(len(frames.images) - lag)
        if moments[k] - frames.step_s >= log_times_s[0]
        and moments[k + lag] + frames.step_s <= log_times_s[-1]
    ]
    if not covered:
        raise SyncError(
            "joint log", "does not cover the moving frames", "export the log of the whole demonstration"
        )
    # The pairs are spread evenly over the energy: motions in different directions separate a time offset from an image shift.
    energy = np.cumsum([frames.change(k, k + lag).sum() + 1e-6 for k in covered])
    marks = (np.arange(FINE_PAIRS) + 0.5) / FINE_PAIRS * energy[-1]
    chosen = np.unique(np.searchsorted(energy, marks))
    return [(covered[i], covered[i] + lag) for i in chosen]


def _vertex(offsets: NDArray, scores: NDArray) -> float:
    """Compute the offset at the vertex of a parabola through the best score and its neighbors."""
    top = int(np.argmax(scores))
    near = slice(max(0, top - 2), top + 3)
    if len(offsets[near]) < 3:
        return float(offsets[top])
    a, b, _ = np.polyfit(offsets[near] - offsets[top], scores[near], 2)
    step = offsets[1] - offsets[0]
    return float(offsets[top] + (np.clip(-b / (2 * a), -step, step) if a < 0 else 0.0))
