"""The offset between the video's clock and the joint log's clock.

Where the robot model, posed by the log, covers a pixel at one of two moments only, the video must
have changed there between these moments; where it covers the pixel at neither, it should not have.
The offset under which that is most likely wins, first on a grid over everything the two clocks
allow, then in steps of a fraction of a frame. Only changes count, so a small error of the camera
pose hardly moves the answer; what is left of it is absorbed by a common shift of the silhouettes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array, freeze
from aomgen.errors import SyncError
from aomgen.io.images import resize
from aomgen.io.video import Video

# Stretches of time left out in turn for the standard deviation, and the smallest one believed.
_BLOCKS = 5
_MIN_SD_S = 0.002

# Robot masks (T, height, width) at log times (T,), width and height in px.
MasksAt = Callable[[Array, int, int], NDArray[np.bool_]]


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockParams:
    """How the offset is searched.

    Attributes:
        width: Image width for the comparison, [px].
        step_s: Coarse step; frames are taken this far apart, [s].
        lags: Distances between compared frames, in coarse steps.
        min_overlap: Share of the video that the log has to cover.
        fine_pairs: Frame pairs used for the fine search.
        fine_steps: Fine steps in one coarse step; five or more are tried around the coarse optimum.
        shift_px: Silhouette shifts tried along x and y in the fine search, [px].
        change_likelihood: Probability of a change where the silhouettes differ.
        max_rival: Largest score of another offset, as share of the best one's.
        rival_distance_s: Offsets farther than this from the best are rivals, [s].
        min_gain_sd: Smallest height of the best score over the others, in their spread.
    """

    width: int = 160
    step_s: float = 0.1
    lags: tuple[int, ...] = (1, 3, 8)
    min_overlap: float = 0.5
    fine_pairs: int = 14
    fine_steps: int = 4
    shift_px: tuple[int, ...] = (-4, -2, 0, 2, 4)
    change_likelihood: float = 0.6
    max_rival: float = 0.85
    rival_distance_s: float = 0.5
    min_gain_sd: float = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockEstimate:
    """Log time = video time + `offset_s`; the coarse scores are kept for the report."""

    offset_s: float
    sd_s: float
    candidates_s: Array
    scores: Array

    def __post_init__(self) -> None:
        freeze(self, "candidates_s", self.candidates_s, (None,))
        freeze(self, "scores", self.scores, (len(self.candidates_s),))


def estimate_clock_offset(
    video: Video, log_times_s: Array, masks_at: MasksAt, params: ClockParams | None = None
) -> ClockEstimate:
    """Find the offset from the arm's own motion.

    Args:
        video: The demonstration.
        log_times_s: Times of the joint log (T,), its own clock, [s].
        masks_at: Draws the robot at log times.
        params: How to search.

    Raises:
        SyncError: The log does not cover enough of the video under any offset, the arm hardly moves
            in view, or two offsets explain the video equally well.

    Not checked: the log's clock runs at the video's rate.
    """
    params = params or ClockParams()
    frames = _Frames.of(video, params)
    candidates, scores = _coarse(frames, log_times_s, masks_at, params)
    best = _unambiguous_peak(candidates, scores, params)
    nearby = slice(max(0, best - 1), best + 2)
    guess = _vertex(candidates[nearby], scores[nearby])
    offset, sd = _fine(frames, guess, log_times_s, masks_at, params)
    return ClockEstimate(offset_s=offset, sd_s=sd, candidates_s=candidates, scores=scores)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Frames:
    """Small frames at nearly equal steps, and the noise between two of them."""

    times_s: Array
    step_s: float
    images: NDArray[np.float32]
    noise: float

    @staticmethod
    def of(video: Video, params: ClockParams) -> "_Frames":
        stride = max(1, round(params.step_s * video.fps))
        height, width = video.frames_srgb.shape[1:3]
        size = (params.width, max(1, round(params.width * height / width)))
        images = np.stack([resize(frame, *size) for frame in video.frames_srgb[::stride]]).astype(np.float32)
        if not len(images) > max(params.lags):
            raise SyncError("video", f"has only {len(images)} frames to compare", "record the whole motion")
        times = video.times_s[::stride]
        noise = 1.4826 * float(np.median(np.abs(np.diff(images, axis=0))))
        step = float((times[-1] - times[0]) / (len(times) - 1))
        return _Frames(times_s=times, step_s=step, images=images, noise=max(noise, 0.5))

    @property
    def size(self) -> tuple[int, int]:
        return self.images.shape[2], self.images.shape[1]

    def change(self, first: int, second: int) -> NDArray[np.float32]:
        """How surely each pixel changed (P,), 0..1; a common brightness change does not count."""
        difference = self.images[second] - self.images[first]
        difference = difference - np.median(difference, axis=(0, 1))
        strength = np.abs(difference).max(-1).ravel()
        low = 4 * self.noise + 4
        return np.clip((strength - low) / (2 * low), 0, 1)


def _weights(changes: NDArray[np.float32], params: ClockParams) -> tuple[NDArray, NDArray]:
    """Log-likelihood gains (K, P) of "the silhouettes differ here" and of "no robot at either moment"."""
    usual = float(np.clip(changes.mean(), 1e-3, 0.5 * params.change_likelihood))
    still = usual / 2

    def gain(probability: float) -> NDArray[np.float32]:
        return changes * np.log(probability / usual) + (1 - changes) * np.log((1 - probability) / (1 - usual))

    return gain(params.change_likelihood), gain(still)


def _coarse(
    frames: _Frames, log_times_s: Array, masks_at: MasksAt, params: ClockParams
) -> tuple[Array, Array]:
    """Score of every offset on the grid; pairs that the log does not cover neither help nor hurt."""
    step, count = frames.step_s, len(frames.images)
    grid = np.arange(log_times_s[0], log_times_s[-1], step)
    need = int(np.ceil(params.min_overlap * count))
    shifts = np.arange(need - count, len(grid) - need + 1)
    if not (len(shifts) and len(grid) > max(params.lags)):
        raise SyncError(
            "joint log",
            f"spans {log_times_s[-1] - log_times_s[0]:.1f} s, too little for a video of {count * step:.1f} s",
            "export the log of the whole demonstration",
        )
    masks = masks_at(np.asarray(grid, np.float64), *frames.size).reshape(len(grid), -1)
    totals = np.zeros(len(shifts))
    for lag in params.lags:
        changes = np.stack([frames.change(k, k + lag) for k in range(count - lag)])
        differ, still = _weights(changes, params)
        first, second = masks[:-lag], masks[lag:]
        table = (
            differ @ (first ^ second).astype(np.float32).T + still @ (~(first | second)).astype(np.float32).T
        )
        totals += [np.trace(table, offset=shift) for shift in shifts]
    return grid[0] + shifts * step - frames.times_s[0], totals


def _unambiguous_peak(candidates: Array, scores: Array, params: ClockParams) -> int:
    best = int(np.argmax(scores))
    base = float(np.median(scores))
    spread = 1.4826 * float(np.median(np.abs(scores - base)))
    gain = float(scores[best]) - base
    if not gain > params.min_gain_sd * max(spread, 1e-9) * 0.5:
        raise SyncError(
            "clock offset",
            f"no offset stands out (best {gain:.0f} over a spread of {spread:.0f})",
            "check the camera pose, or give clock_offset_s",
        )
    far = np.abs(candidates - candidates[best]) > params.rival_distance_s
    rival = float(scores[far].max() - base) / gain if far.any() else 0.0
    if not rival < params.max_rival:
        other = candidates[far][int(np.argmax(scores[far]))]
        raise SyncError(
            "clock offset",
            f"{candidates[best]:.2f} s and {other:.2f} s explain the video nearly equally well "
            f"({rival:.0%}, limit {params.max_rival:.0%})",
            "give clock_offset_s",
        )
    return best


def _fine(
    frames: _Frames, guess_s: float, log_times_s: Array, masks_at: MasksAt, params: ClockParams
) -> tuple[float, float]:
    """Offset between grid points and its standard deviation, from pairs spread over the motion."""
    pairs = _telling_pairs(frames, guess_s, log_times_s, params)
    weights = _weights(np.stack([frames.change(*pair) for pair in pairs]), params)
    step = frames.step_s / params.fine_steps
    columns: dict[int, Array] = {}
    low, high = -2, 2
    while True:
        for index in range(low, high + 1):
            if index not in columns:
                columns[index] = _fine_scores(
                    frames, pairs, weights, guess_s + index * step, masks_at, params
                )
        offsets = guess_s + np.arange(low, high + 1) * step
        table = np.stack([columns[index] for index in range(low, high + 1)], 1)
        top = low + int(np.argmax(table.sum(0).max(1)))
        # The silhouettes' shift may draw the optimum away from the coarse guess: follow it.
        if low < top < high or high - low >= 2 * params.fine_steps:
            break
        low, high = min(low, top - 1), max(high, top + 1)
    best = _peak(offsets, table.sum(0))
    blocks = np.array_split(np.arange(len(pairs)), min(_BLOCKS, len(pairs)))
    left_out = np.array([_peak(offsets, np.delete(table, block, 0).sum(0)) for block in blocks])
    # Jackknife over stretches of time, in which a wrong camera pose acts alike.
    sd = np.sqrt((len(blocks) - 1) / len(blocks) * np.sum((left_out - left_out.mean()) ** 2))
    return best, float(max(sd, _MIN_SD_S))


def _fine_scores(
    frames: _Frames,
    pairs: list[tuple[int, int]],
    weights: tuple[NDArray, NDArray],
    offset_s: float,
    masks_at: MasksAt,
    params: ClockParams,
) -> Array:
    """Score (K, S) of each pair under each shift of the silhouettes."""
    moments = sorted({k for pair in pairs for k in pair})
    row = {k: i for i, k in enumerate(moments)}
    masks = masks_at(frames.times_s[moments] + offset_s, *frames.size)
    first, second = masks[[row[k] for k, _ in pairs]], masks[[row[k] for _, k in pairs]]
    apart, away = first ^ second, ~(first | second)
    differ, still = weights
    scores = []
    for shift in product(params.shift_px, repeat=2):
        moved = [np.roll(part, shift, (1, 2)).reshape(len(pairs), -1) for part in (apart, away)]
        scores.append((differ * moved[0] + still * moved[1]).sum(1))
    return np.stack(scores, 1)


def _telling_pairs(
    frames: _Frames, offset_s: float, log_times_s: Array, params: ClockParams
) -> list[tuple[int, int]]:
    lag = params.lags[len(params.lags) // 2]
    covered = [
        k
        for k in range(len(frames.images) - lag)
        if frames.times_s[k] + offset_s - frames.step_s >= log_times_s[0]
        and frames.times_s[k + lag] + offset_s + frames.step_s <= log_times_s[-1]
    ]
    if not covered:
        raise SyncError(
            "joint log", "does not cover the moving frames", "export the log of the whole demonstration"
        )
    # Evenly over the energy, not the strongest: strokes in different directions tell time from shift.
    energy = np.cumsum([frames.change(k, k + lag).sum() + 1e-6 for k in covered])
    marks = (np.arange(params.fine_pairs) + 0.5) / params.fine_pairs * energy[-1]
    chosen = np.unique(np.searchsorted(energy, marks))
    return [(covered[i], covered[i] + lag) for i in chosen]


def _peak(offsets: NDArray, table: NDArray) -> float:
    """Maximum of a score over offsets and shifts (D, S)."""
    return _vertex(offsets, table.max(1))


def _vertex(offsets: NDArray, scores: NDArray) -> float:
    """Where a parabola through the best score and its neighbours is highest."""
    top = int(np.argmax(scores))
    near = slice(max(0, top - 2), top + 3)
    if len(offsets[near]) < 3:
        return float(offsets[top])
    a, b, _ = np.polyfit(offsets[near] - offsets[top], scores[near], 2)
    step = offsets[1] - offsets[0]
    return float(offsets[top] + (np.clip(-b / (2 * a), -step, step) if a < 0 else 0.0))
