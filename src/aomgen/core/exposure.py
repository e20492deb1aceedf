"""Exposure and white balance, as one gain per channel in linear light."""

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import illuminate_srgb, linear_from_srgb
from aomgen.core.robust import compute_masked_median
from aomgen.core.values import Array

# Range of colors that are neither dominated by noise nor clipped, sRGB 0..1.
_DARK, _BRIGHT = 0.08, 0.92
# Largest gain; a larger ratio of colors is not caused by exposure.
_MAX_GAIN = 4.0
# Number of frames, spread evenly over the video, from which the median image is computed, and stride of the pixels that are
# compared; both are sufficient for medians.
_SAMPLES, _STRIDE = 15, 3
# A frame is invalid if its residual from the median image exceeds the median residual of all frames by this factor, and also
# exceeds the level of noise and compression, in 8-bit values.
_BAD, _NOISE = 6.0, 3.0


def fit_gains(seen_srgb: NDArray[np.floating], target_srgb: NDArray[np.floating]) -> Array:
    """Fit the gains (3,) that convert observed colors to target colors (N, 3), sRGB 0..1.

    The gains are medians over colors that are neither dark nor clipped; a channel without such colors gets the gain 1.
    """
    lower, upper = np.minimum(seen_srgb, target_srgb), np.maximum(seen_srgb, target_srgb)
    ratios = linear_from_srgb(target_srgb) / np.maximum(linear_from_srgb(seen_srgb), 1e-3)
    gains, known = compute_masked_median(ratios, (lower > _DARK) & (upper < _BRIGHT))
    return np.where(known, np.clip(gains, 1 / _MAX_GAIN, _MAX_GAIN), 1.0).astype(np.float64)


def change_exposure(image_srgb: NDArray[np.uint8], gains: Array) -> NDArray[np.uint8]:
    """Multiply the linear colors of an 8-bit sRGB image (..., 3) by gains (3,); the results are limited to 255."""
    table = np.minimum(illuminate_srgb(np.arange(256)[:, None] / 255, gains), 1)
    return np.rint(255 * table).astype(np.uint8)[image_srgb, np.arange(3)]


def match_frames(
    frames_srgb: NDArray[np.uint8], hidden: NDArray[np.bool_], region: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Match every frame of a fixed camera to the exposure of the video's median image, by the static scene.

    Args:
        frames_srgb: Frames of the video (T, H, W, 3).
        hidden: Masks of the robot (T, H, W).
        region: Mask of the moving part at its scanned pose (H, W).

        Returns:
            Frames (T, H, W, 3), and a mask (T,) of frames with deviating content, for example dropouts, flashes or cuts.

        Not checked: whether the static scene covers more than half of the image.
    """
    still = ~region[::_STRIDE, ::_STRIDE]
    colors = frames_srgb[:, ::_STRIDE, ::_STRIDE][:, still]
    seen = ~hidden[:, ::_STRIDE, ::_STRIDE][:, still]
    chosen = np.linspace(0, len(colors) - 1, min(_SAMPLES, len(colors))).astype(int)
    common, known = compute_masked_median(colors[chosen], seen[chosen])
    matched = np.empty_like(frames_srgb)
    errors = np.full(len(frames_srgb), np.inf)
    for k, frame in enumerate(frames_srgb):
        shown = seen[k] & known
        gains = fit_gains(colors[k, shown] / 255, common[shown] / 255)
        matched[k] = change_exposure(frame, gains)
        if shown.any():
            left = change_exposure(colors[k, shown], gains) - common[shown]
            errors[k] = np.median(np.abs(left).max(-1))
    return matched, errors > max(_BAD * float(np.median(errors)), _NOISE)
