"""The offset between the video's clock and the joint log's clock, from silhouettes alone.

Where the robot model, posed by the log, covers a pixel at one of two moments only, the video must
have changed there between these moments; where it covers the pixel at neither, it should not have.
The offset under which that is most likely wins, first on a grid over everything the two clocks
allow, with clocks that drift against one another among the hypotheses, then in steps of a fraction
of a frame. Only changes count, so a small error of the camera pose hardly moves the answer; what is
left of it is absorbed by a common shift of the silhouettes. `bundle_adjustment` continues from here.
"""

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from aomgen.alignment.time_offset_frames import (
    FINE_STEPS,
    LAGS,
    MAX_RATE,
    MAX_RIVAL,
    MIN_CHANGE,
    MIN_GAIN_SD,
    MIN_OVERLAP,
    RIVAL_DISTANCE_S,
    SHIFTS_PX,
    ClockFrames,
    ClockParams,
    change_gains,
)
from aomgen.core.clock import Clock
from aomgen.core.robust import robust_sd
from aomgen.core.values import Array
from aomgen.errors import SyncError
from aomgen.io.video import Video
from aomgen.robots.robot_masks import MasksAt

# Segments of time left out in turn for the standard deviation (jackknife).
_BLOCKS = 5
# Smallest standard deviation believed, [s]: a few milliseconds are within the jitter of video time stamps.
_MIN_SD_S = 0.002


def estimate_clock(
    video: Video, log_times_s: Array, masks_at: MasksAt, params: ClockParams | None = None
) -> Clock:
    """Find the offset, and roughly the drift, from the arm's own motion.

    Args:
        video: The demonstration.
        log_times_s: Times of the joint log (T,), its own clock, [s].
        masks_at: Draws the robot at log times.
        params: How to search.

    Returns:
        The clock; its drift is known to half a step between the drifts tried.

    Raises:
        SyncError: The log does not cover enough of the video under any offset, the arm stands still
            or out of view, or two offsets explain the video equally well.

    Not checked: a drift that changes during the demonstration.
    """
    params = params or ClockParams()
    frames = ClockFrames.of(video, params)
    tables = _coarse_tables(frames, log_times_s, masks_at)
    rates, candidates, scores = _coarse_scores(frames, tables, log_times_s)
    none, best = len(rates) // 2, int(np.argmax(scores.max(1)))
    _refuse_ambiguous(candidates, scores[best])
    found = [
        _fine(frames, _guess(frames, rates, candidates, scores, row), log_times_s, masks_at, params)
        for row in sorted({none, best})
    ]
    return max(found, key=lambda item: item[1])[0]


def _coarse_tables(frames: ClockFrames, log_times_s: Array, masks_at: MasksAt) -> list[Array]:
    """For each lag, the score (K, M) of video frame k and its follower shown at grid time m."""
    grid = _grid(frames, log_times_s)
    if not len(grid) > max(LAGS):
        raise _too_short(frames, log_times_s)
    masks = masks_at(grid, *frames.size).reshape(len(grid), -1)
    moved = max(float((masks[:-lag] ^ masks[lag:]).mean(1).max()) for lag in LAGS)
    if not moved >= MIN_CHANGE:
        raise SyncError(
            "clock offset",
            f"the arm stands still in the joint log or moves out of view: its silhouette changes by at most "
            f"{moved:.2%} of the picture, want {MIN_CHANGE:.1%}",
            "record a demonstration that this camera sees, or give clock_offset_s",
        )
    tables = []
    for lag in LAGS:
        changes = np.stack([frames.change(k, k + lag) for k in range(len(frames.images) - lag)])
        differ, still = change_gains(changes)
        first, second = masks[:-lag], masks[lag:]
        apart, away = first ^ second, ~(first | second)
        tables.append(differ @ apart.astype(np.float32).T + still @ away.astype(np.float32).T)
    return tables


def _coarse_scores(
    frames: ClockFrames, tables: list[Array], log_times_s: Array
) -> tuple[Array, Array, Array]:
    """Drifts (R,), offsets at the middle of the video (C,), and the score (R, C) of each pair of them.

    Frame pairs that the log does not cover neither help nor hurt.
    """
    count, size = len(frames.images), len(_grid(frames, log_times_s))
    need = int(np.ceil(MIN_OVERLAP * count))
    shifts = np.arange(need - count, size - need + 1)
    if not len(shifts):
        raise _too_short(frames, log_times_s)
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
    return rates, log_times_s[0] + shifts * frames.step_s - frames.times_s[0], scores


def _guess(frames: ClockFrames, rates: Array, candidates: Array, scores: Array, row: int) -> Clock:
    """The best clock of one drift (row of the scores)."""
    best = int(np.argmax(scores[row]))
    nearby = slice(max(0, best - 1), best + 2)
    return Clock(
        offset_s=_vertex(candidates[nearby], scores[row, nearby]),
        rate=float(rates[row]),
        rate_sd=float(rates[1] - rates[0]) / 2,
        middle_s=frames.middle_s,
    )


def _grid(frames: ClockFrames, log_times_s: Array) -> Array:
    return np.arange(log_times_s[0], log_times_s[-1], frames.step_s, dtype=np.float64)


def _too_short(frames: ClockFrames, log_times_s: Array) -> SyncError:
    return SyncError(
        "joint log",
        f"spans {log_times_s[-1] - log_times_s[0]:.1f} s, too little for a video of "
        f"{len(frames.images) * frames.step_s:.1f} s",
        "export the log of the whole demonstration",
    )


def _refuse_ambiguous(candidates: Array, scores: Array) -> None:
    best = int(np.argmax(scores))
    base = float(np.median(scores))
    spread = robust_sd(scores - base)
    gain = float(scores[best]) - base
    if not gain > MIN_GAIN_SD * max(spread, 1e-9) * 0.5:
        raise SyncError(
            "clock offset",
            f"no offset stands out (best {gain:.0f} over a spread of {spread:.0f})",
            "check the camera pose, or give clock_offset_s",
        )
    far = np.abs(candidates - candidates[best]) > RIVAL_DISTANCE_S
    rival = float(scores[far].max() - base) / gain if far.any() else 0.0
    if not rival < MAX_RIVAL:
        other = candidates[far][int(np.argmax(scores[far]))]
        raise SyncError(
            "clock offset",
            f"{candidates[best]:.2f} s and {other:.2f} s explain the video nearly equally well "
            f"({rival:.0%}, limit {MAX_RIVAL:.0%})",
            "give clock_offset_s",
        )


def _fine(
    frames: ClockFrames, guess: Clock, log_times_s: Array, masks_at: MasksAt, params: ClockParams
) -> tuple[Clock, float]:
    """The clock with its offset between grid points, and its score, from pairs spread over the motion."""
    pairs = _telling_pairs(frames, guess, log_times_s, params)
    weights = change_gains(np.stack([frames.change(*pair) for pair in pairs]))
    step = frames.step_s / FINE_STEPS
    columns: dict[int, Array] = {}
    low, high = -2, 2
    while True:
        for index in range(low, high + 1):
            if index not in columns:
                clock = replace(guess, offset_s=guess.offset_s + index * step)
                columns[index] = _fine_scores(frames, pairs, weights, clock, masks_at)
        offsets = guess.offset_s + np.arange(low, high + 1) * step
        table = np.stack([columns[index] for index in range(low, high + 1)], 1)
        top = low + int(np.argmax(table.sum(0).max(1)))
        # The silhouettes' shift may draw the optimum away from the coarse guess: follow it.
        if low < top < high or high - low >= 2 * FINE_STEPS:
            break
        low, high = min(low, top - 1), max(high, top + 1)
    best = _peak(offsets, table.sum(0))
    blocks = np.array_split(np.arange(len(pairs)), min(_BLOCKS, len(pairs)))
    left_out = np.array([_peak(offsets, np.delete(table, block, 0).sum(0)) for block in blocks])
    # Jackknife over segments of time, in which a wrong camera pose acts alike.
    sd = np.sqrt((len(blocks) - 1) / len(blocks) * np.sum((left_out - left_out.mean()) ** 2))
    return replace(guess, offset_s=best, sd_s=float(max(sd, _MIN_SD_S))), float(table.sum(0).max())


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


def _telling_pairs(
    frames: ClockFrames, clock: Clock, log_times_s: Array, params: ClockParams
) -> list[tuple[int, int]]:
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
