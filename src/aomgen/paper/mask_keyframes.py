"""The paper's motion score over the video, and the frames that its threshold flags."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from aomgen.core.robust import SD_OF_MAD
from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import InputError, NoMotionError

# "printed": the formulas as they stand. "repaired": with the least change that lets them work.
Variant = Literal["printed", "repaired"]

# The paper names the filter, not its size; eleven frames and third order are its usual ones.
SMOOTH_FRAMES, SMOOTH_ORDER = 11, 3
# Percentile of the scores that is the paper's B, [%].
BASELINE_PERCENT = 20.0
# Sigmas above B at which a frame is flagged, as printed.
NOISE_UNITS = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PartMasks:
    """What a video segmenter gives: one mask of each in every frame of the demonstration.

    Attributes:
        moving: Visible pixels of the moving part (T, H, W).
        robot: Pixels of the robot (T, H, W).
    """

    moving: Annotated[NDArray[np.bool_], "T H W"]
    robot: Annotated[NDArray[np.bool_], "T H W"]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """The motion score of a video and the level that a moving frame exceeds.

    Attributes:
        scores: Motion score (T,); the last frame has no successor and repeats the one before.
        smoothed: The same, smoothed (T,).
        threshold: The level.
    """

    scores: Annotated[Array, "T"]
    smoothed: Annotated[Array, "T"]
    threshold: float

    __post_init__ = freeze_arrays


def motion_scores(masks: PartMasks) -> Array:
    """Share (T - 1,) of the part's pixels that the next frame's mask lost, 0..1.

    From either mask the other frame's robot is taken away first. Where nothing is left of the first
    mask the score is 0.

    Source: AOMGen, sec. 4.2, "Keyframe Extraction". As there, a mask that only grows scores 0.
    """
    before = masks.moving[:-1] & ~masks.robot[1:]
    after = masks.moving[1:] & ~masks.robot[:-1]
    sizes = before.sum((1, 2))
    return (before & ~after).sum((1, 2)) / np.maximum(sizes, 1)


def smoothed_scores(scores: Array) -> Array:
    """Savitzky-Golay smoothed scores (T,); a series shorter than the filter stays as it is."""
    if len(scores) < SMOOTH_FRAMES:
        return np.array(scores)
    return np.asarray(savgol_filter(scores, SMOOTH_FRAMES, SMOOTH_ORDER))


def score_threshold(scores: Array, smoothed: Array, variant: Variant) -> float:
    """The level B + 3 sigma that a moving frame exceeds.

    B is the 20th percentile of the scores (T,). Printed: sigma is the standard deviation of the scores
    themselves, so that a motion raises its own threshold: two levels are told apart only when the
    higher one lasts less than an eighth of the video, or more than seven. Repaired: sigma is the
    robust spread of the scores about their smooth course (T,).

    Source: AOMGen, sec. 4.2, "Keyframe Extraction".
    """
    base = float(np.percentile(scores, BASELINE_PERCENT))
    if variant == "printed":
        return base + NOISE_UNITS * float(np.std(scores))
    rough = scores - smoothed
    return base + NOISE_UNITS * SD_OF_MAD * float(np.median(np.abs(rough - np.median(rough))))


def scored_frames(masks: PartMasks, variant: Variant = "printed") -> Scores:
    """Score of every frame of a video, and the threshold that follows from them.

    Raises:
        InputError: Fewer than two frames.
    """
    if not len(masks.moving) >= 2:
        raise InputError("masks of the demonstration", f"{len(masks.moving)} frames, need 2", "give them all")
    scores = motion_scores(masks)
    smoothed = smoothed_scores(scores)
    return Scores(
        scores=np.append(scores, scores[-1]),
        smoothed=np.append(smoothed, smoothed[-1]),
        threshold=score_threshold(scores, smoothed, variant),
    )


def flagged_frames(scored: Scores) -> tuple[int, int]:
    """First and last frame whose smoothed score exceeds the threshold.

    Raises:
        NoMotionError: No frame does.

    Source: AOMGen, sec. 4.2, "Keyframe Extraction". As there, one flagged frame sets an end of the
    interval, however far from the others it is.
    """
    flagged = np.flatnonzero(scored.smoothed > scored.threshold)
    if not len(flagged):
        raise NoMotionError(
            "demonstration video",
            "no frame's motion score passes the paper's threshold: the highest is "
            f"{scored.smoothed.max():.4f}, the threshold {scored.threshold:.4f}",
            "use motion_method = 'aomotion'; this threshold grows with the share of moving frames",
        )
    return int(flagged[0]), int(flagged[-1])
