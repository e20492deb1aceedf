"""A bar that crosses a gripper's pads, found in the few points that a thin thing is reconstructed with."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array, freeze

# Where a bar is, is decided by what lies within this of its middle: twice what thin surfaces are off, [m].
_MIDDLE_M = 0.004
_PLACES_M = 0.001
# A bar is supported where its points are, in steps of this, [m]. What is behind it, at least a finger's thickness
# away, is not reached over a gap of more steps than these.
_STEP_M = 0.004
_GAP = 5
# Steps to either side of the pad's middle.
_REACH = 32
# What is seen of a bar has at least this share of its steps occupied.
_MIN_OCCUPIED = 1 / 3
# Share of what is between the pads that belongs to the bar; less is a thing of another shape.
_MIN_SHARE = 0.7
# Directions all around: over the width of a pad, a line between two of them leaves a bar by less than its middle.
_FAN = 12
# Points within this of each other are off alike, [m].
_PATCH_M = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Ways:
    """Directions in which a bar may run over a face.

    Attributes:
        directions: Unit (W, 2).
        sd_rad: How far a bar may be off the nearest one.
    """

    directions: Array
    sd_rad: float

    def __post_init__(self) -> None:
        freeze(self, "directions", self.directions, (None, 2))

    @staticmethod
    def any() -> "Ways":
        """All around, in as many steps as the width of a bar asks for."""
        angles = np.pi / _FAN * np.arange(_FAN)
        return Ways(directions=np.stack([np.cos(angles), np.sin(angles)], 1), sd_rad=np.pi / _FAN / 2)


def swept_bar(local: Array, half: Array, ways: Ways, depth_m: float, flatness: float) -> Array | None:
    """The bar as matter that is even along it; None if what crosses the pad is no bar.

    Args:
        local: Points (N, 3) in a face's frame, z towards the other face, between both and some way
            beside them, [m].
        half: Half extents of the face (2,), [m].
        ways: How a bar may run.
        depth_m: How far the pads are open, [m]: a bar is about as deep as it is thick.
        flatness: How likely a side of the bar lies flat against the face, 0..1; a bar that does not is
            touched along its middle, on average.

    Returns:
        Points (K, 3) of the same cross section, from one end of the bar to the other.

    Not checked: bars that bend by more than their width beside the pads.
    """
    if not len(local):
        return None
    flat = local[:, :2]
    point, direction, near = _line(flat, half, ways, depth_m)
    if near.sum() < 2:
        return None
    places = (flat[near] - point) @ direction
    low, high = float(places.min()), float(places.max())
    occupied = len(np.unique(np.floor((places - low) / _STEP_M)))
    inside = np.all(np.abs(flat) <= half, axis=1)
    within = np.abs((flat - point) @ _across(direction)) <= max(_MIDDLE_M, (depth_m + _MIDDLE_M) / 2)
    if inside.any() and not within[inside].mean() >= _MIN_SHARE:
        return None
    if not (high - low >= 2 * half.max() and occupied * _STEP_M >= _MIN_OCCUPIED * (high - low)):
        return None
    # It goes on where it was not seen, as far as it does in between.
    unseen = _GAP * _STEP_M / 2
    steps = np.arange(low - unseen, high + unseen, _STEP_M / 2)
    # As deep as the pads are open, in place of as deep as it was reconstructed.
    ranks = np.argsort(np.argsort((flat[near] - point) @ _across(direction)))
    off = flatness * depth_m * ((ranks + 0.5) / len(ranks) - 0.5)
    ahead = point + steps[:, None, None] * direction + off[:, None] * _across(direction)
    heights = np.broadcast_to(local[near, 2], ahead.shape[:2])
    return np.concatenate([ahead, heights[..., None]], axis=-1).reshape(-1, 3)


def _across(direction: Array) -> Array:
    return np.array([-direction[1], direction[0]])


def _line(flat: Array, half: Array, ways: Ways, depth_m: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Point (2,) and direction (2,) of the line over the face along which points (N, 2) go on farthest, and which do."""
    best, found = -1.0, (np.zeros(2), np.array([1.0, 0.0]), np.zeros(len(flat), bool))
    for way in ways.directions:
        across, along = flat @ _across(way), flat @ way
        room = np.abs(_across(way)) @ half
        offsets = np.arange(-room, room, _PLACES_M)
        near = np.abs(across[:, None] - offsets) <= _MIDDLE_M
        bins = np.floor(along / _STEP_M).astype(np.int64) + _REACH
        kept = (bins >= 0) & (bins < 2 * _REACH)
        occupied = np.zeros((2 * _REACH, len(offsets)), bool)
        np.logical_or.at(occupied, bins[kept], near[kept])
        reached = _reached(occupied)
        scores = reached.sum(0) + near.mean(0)
        k = int(np.argmax(scores))
        if scores[k] > best:
            which = near[:, k] & kept
            which[kept] &= reached[bins[kept], k]
            best, found = float(scores[k]), (*_turned(flat[which], way, ways.sd_rad, depth_m), which)
    return found


def _turned(flat: Array, way: Array, sd_rad: float, depth_m: float) -> tuple[Array, Array]:
    """Point and direction of points (N, 2) that are nearly along a way."""
    if len(flat) < 2:
        return np.zeros(2), way
    point = flat.mean(0)
    along, across = (flat - point) @ way, (flat - point) @ _across(way)
    patches = len(np.unique(np.floor(along / _PATCH_M)))
    spread = float(along @ along)
    # What points all over the bar's depth tell of the angle, against what is known before.
    noise2 = depth_m**2 / 12 * len(flat) / patches
    slope = float(along @ across) / (spread + noise2 / sd_rad**2)
    direction = way + slope * _across(way)
    return point, direction / np.linalg.norm(direction)


def _reached(occupied: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which occupied steps (2 R, L) of lines are reached from their middles without too wide a gap."""
    ahead, behind = occupied[_REACH:], occupied[:_REACH][::-1]
    return np.concatenate([_onwards(behind)[::-1], _onwards(ahead)])


def _onwards(occupied: NDArray[np.bool_]) -> NDArray[np.bool_]:
    steps = np.arange(len(occupied))[:, None]
    last = np.maximum.accumulate(np.where(occupied, steps, -1), axis=0)
    before = np.concatenate([np.full((1, last.shape[1]), -1), last[:-1]])
    broken = np.logical_or.accumulate(occupied & (steps - before > _GAP + 1), axis=0)
    return occupied & ~broken
