"""A bar that crosses a gripper's pads, found in the few points that a thin thing is reconstructed with."""

import numpy as np

from aomgen.core.values import Array

# A line is supported where the bar's points are, in steps of this, [m].
_STEP_M = 0.004
# What is seen of a bar has at least this share of its steps occupied.
_MIN_OCCUPIED = 0.5
# Share of what is between the pads that belongs to the bar; less is a thing of another shape.
_MIN_SHARE = 0.7
_MOST_POINTS = 80


def swept_bar(local: Array, half: Array, widths_m: tuple[float, float], flatness: float) -> Array | None:
    """The bar's points spread evenly along it; None if what crosses the pad is no bar.

    Args:
        local: Points (N, 3) in a face's frame, z towards the other face, between both and some way
            beside them, [m].
        half: Half extents of the face (2,), [m].
        widths_m: What decides where the bar is lies within the first of these of its middle, seen on the
            face, and all of it within the second: a bar is about as deep as the pads are open, [m].
        flatness: How likely a side of the bar lies flat against the face, 0..1; a bar that does not is
            touched along its middle, on average.

    Returns:
        Points (K, 3) of the same cross section, from one end of the bar to the other.

    Not checked: bars that bend by more than their width beside the pads.
    """
    flat = local[:, :2]
    found = _line(flat, half, widths_m[0])
    if found is None:
        return None
    point, direction = found
    for _ in range(2):
        near = np.abs((flat - point) @ _across(direction)) <= widths_m[0]
        point = flat[near].mean(0)
        direction = np.linalg.svd(flat[near] - point, full_matrices=False)[2][0]
    inside = np.all(np.abs(flat) <= half, axis=1)
    places = (flat[near] - point) @ direction
    low, high = float(places.min()), float(places.max())
    occupied = len(np.unique(np.floor((places - low) / _STEP_M)))
    within = np.abs((flat - point) @ _across(direction)) <= widths_m[1]
    if inside.any() and not within[inside].mean() >= _MIN_SHARE:
        return None
    if not (high - low >= 2 * half.max() and occupied * _STEP_M >= _MIN_OCCUPIED * (high - low)):
        return None
    steps = np.arange(low, high, _STEP_M / 2)
    off = flatness * (flat[near] - point) @ _across(direction)
    ahead = point + steps[:, None, None] * direction + off[:, None] * _across(direction)
    heights = np.broadcast_to(local[near, 2], ahead.shape[:2])
    return np.concatenate([ahead, heights[..., None]], axis=-1).reshape(-1, 3)


def _across(direction: Array) -> Array:
    return np.array([-direction[1], direction[0]])


def _line(flat: Array, half: Array, width_m: float) -> tuple[Array, Array] | None:
    """Point (2,) and direction (2,) of the line over the face along which points (N, 2) go farthest."""
    if len(flat) < 4:
        return None
    thinned = flat[:: int(np.ceil(len(flat) / _MOST_POINTS))]
    first, second = np.triu_indices(len(thinned), 1)
    ways = thinned[second] - thinned[first]
    lengths = np.linalg.norm(ways, axis=1)
    directions = ways / np.maximum(lengths, 1e-9)[:, None]
    normals = np.stack([-directions[:, 1], directions[:, 0]], 1)
    places = np.einsum("ld,ld->l", normals, thinned[first])
    # The line passes over the face: its corners are not all on one side.
    corners = half * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    sides = normals @ corners.T - places[:, None]
    usable = (lengths > half.max()) & (sides.min(1) < 0) & (sides.max(1) > 0)
    if not usable.any():
        return None
    normals, places, directions = normals[usable], places[usable], directions[usable]
    near = np.abs(flat @ normals.T - places) <= width_m
    bins = np.floor(flat @ directions.T / _STEP_M).astype(np.int64)
    bins = np.clip(bins + 32, 0, 63)
    flags = np.where(near, np.left_shift(np.uint64(1), bins.astype(np.uint64)), np.uint64(0))
    scores = np.bitwise_count(np.bitwise_or.reduce(flags, axis=0))
    best = int(np.argmax(scores + near.mean(0)))
    return normals[best] * places[best], directions[best]
