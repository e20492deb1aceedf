"""When a motion begins and ends, between frames: the picture says how far along the hand's way, the hand says when."""

from dataclasses import dataclass

import numpy as np

from aomgen.core.values import Array
from aomgen.motion.filters import remove_glitches

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
# Joint logs of a resting hand wander by less than this, smoothed, [m].
_JITTER_M = 0.001


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperPath:
    """The hand over dense times.

    Attributes:
        times_s: (D,), increasing, [s].
        points: Place of the hand (D, 3), smooth, world frame, [m].
    """

    times_s: Array
    points: Array

    def between(self, first_s: float, last_s: float) -> "GripperPath":
        """The part of the way inside an interval."""
        inside = (self.times_s >= first_s - 1e-9) & (self.times_s <= last_s + 1e-9)
        return GripperPath(times_s=self.times_s[inside], points=self.points[inside])

    def reversed(self) -> "GripperPath":
        """The way gone backwards, with negative times."""
        return GripperPath(times_s=-self.times_s[::-1], points=self.points[::-1])

    @property
    def travel(self) -> Array:
        """Farthest distance (D,) from the first point so far, [m]."""
        return np.maximum.accumulate(np.linalg.norm(self.points - self.points[0], axis=1))

    @property
    def length(self) -> Array:
        """Length (D,) of the way gone so far, [m]; to and fro within `_JITTER_M` is none."""
        gone, anchor = np.zeros(len(self.points)), 0
        for k in range(1, len(gone)):
            step = float(np.linalg.norm(self.points[k] - self.points[anchor]))
            gone[k] = max(gone[k - 1], gone[anchor] + step)
            anchor = k if step >= _JITTER_M else anchor
        return gone


def detect_onset(
    way: GripperPath, times_s: Array, departures: Array, noise: float, pixel_m: float, *, held: bool
) -> float:
    """When the part leaves its first place, [s].

    The departure is taken to be `k max(0, u - u0)^p` with u the hand's travel (its way, if not held): 0 while the hand comes or
    slides, then growing with it. k is fitted, p is summed over, u0 has a posterior. Less than a pixel
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
    clean = remove_glitches(departures)
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

    Args:
        ahead: Share (T,) of the part's picture that does not show its last place.
        way, times_s, noise, pixel_m, held: As in `detect_onset`.
    """
    return -detect_onset(way.reversed(), -times_s[::-1], ahead[::-1], noise, pixel_m, held=held)
