"""Frames of a fixed camera brought to one exposure, and those that do not belong to the video."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array

# Frames that make the common picture, evenly over the video.
_SAMPLES = 15
# Every n-th pixel is enough for a median.
_STRIDE = 3
# Values (8 bit) that are neither drowned in noise nor clipped.
_DARK, _BRIGHT = 20.0, 235.0
# A frame whose rest differs this many times more than usual from the common picture is a bad one.
_BAD = 6.0
# Differences (8 bit) below this are noise and video compression.
_QUIET = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchedFrames:
    """A video at one exposure.

    Attributes:
        frames_srgb: (T, H, W, 3) uint8.
        bad: Frames (T,) that show something else than the others: drop-outs, flashes, cuts.
    """

    frames_srgb: NDArray[np.uint8]
    bad: NDArray[np.bool_]


def match_exposure(
    frames_srgb: NDArray[np.uint8], hidden: NDArray[np.bool_], region: NDArray[np.bool_]
) -> MatchedFrames:
    """Scale the colors of every frame so that what stands still keeps its color.

    Per frame and channel one factor: the median ratio to the video's median picture, over pixels that
    show neither the robot nor the part's place. Frames that differ from it all the same are called bad.

    Args:
        frames_srgb: (T, H, W, 3).
        hidden: Where the robot is (T, H, W).
        region: Where the part is at its scanned place (H, W).

    Not checked: that the standing scene fills more than half of the picture.
    """
    still = ~region[::_STRIDE, ::_STRIDE]
    small = frames_srgb[:, ::_STRIDE, ::_STRIDE][:, still].astype(np.float32)
    small[hidden[:, ::_STRIDE, ::_STRIDE][:, still]] = np.nan
    chosen = np.linspace(0, len(small) - 1, min(_SAMPLES, len(small))).astype(int)
    common = _median(small[chosen], 0, otherwise=0.0)
    usable = (common > _DARK) & (common < _BRIGHT)
    small[~((small > _DARK) & (small < _BRIGHT))] = np.nan
    ratios = np.where(usable, common, np.nan) / small
    gains = _median(ratios, 1, otherwise=1.0)
    errors = _median(np.abs(small * gains[:, None] - common).max(-1), 1, otherwise=np.inf)
    bad = errors > _BAD * np.maximum(np.median(errors), _QUIET / _BAD)
    matched = np.empty_like(frames_srgb)
    for out, frame, gain in zip(matched, frames_srgb, gains, strict=True):
        np.clip(np.rint(frame * gain.astype(np.float32)), 0, 255, out=out, casting="unsafe")
    return MatchedFrames(frames_srgb=matched, bad=bad)


def _median(values: NDArray[np.floating], axis: int, otherwise: float) -> Array:
    """Median along an axis, NaN left out; `otherwise` where nothing is left."""
    empty = np.isnan(values).all(axis=axis, keepdims=True)
    filled = np.where(empty, otherwise, values)
    return np.asarray(np.nanmedian(filled, axis=axis), np.float64)
