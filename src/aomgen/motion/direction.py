"""Whether a demonstration opened or closed the object, from where its part was and where it went."""

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.joint import Joint
from aomgen.core.motion import Direction
from aomgen.core.transforms import apply
from aomgen.core.values import Array

# A part that leaves the body takes along at least this share of its travel; one that slides within it none.
_LEAVING_SHARE = 0.2
# Cells of the body's front along its longer side.
_CELLS = 24
# The front is what lies within this many cells of the sliding panel's own depth.
_FRONT_CELLS = 2.0
_TAIL_PERCENT = 2.0


def direction_of(joint: Joint, theta: float, points_static: Array, points_moving: Array) -> Direction:
    """Open or close: what a part does that goes from its scanned place to joint value `theta`.

    A closed part is flush with the body: a door or lid lies on it, a drawer is inside of it. A panel
    that slides along the body is flush everywhere; it is closed where it covers what nothing else does.

    Args:
        joint: Value 0 is the scanned place, world frame.
        theta: Value at the end of the motion, [rad] or [m].
        points_static: Of the body (N, 3), world frame, [m].
        points_moving: Of the part at its scanned place (M, 3), world frame, [m].

    Not checked: a door that swings from half a turn open to a quarter is as far from the body as before.
    """
    ends = (points_moving, apply(joint.motion(theta), points_moving))
    if joint.type == "revolute":
        tree = cKDTree(points_static)
        first, last = (float(tree.query(points)[0].mean()) for points in ends)
        return "opening" if last >= first else "closing"
    beyond = [_beyond(points @ joint.axis, points_static @ joint.axis) for points in ends]
    if abs(beyond[1] - beyond[0]) >= _LEAVING_SHARE * abs(theta):
        return "opening" if beyond[1] > beyond[0] else "closing"
    first, last = (_covered(points, points_static, joint.axis) for points in ends)
    return "opening" if last <= first else "closing"


def _beyond(places: Array, body: Array) -> float:
    """How far places (M,) stick out of the range of the body's (N,) on average, [m]."""
    low, high = np.percentile(body, [_TAIL_PERCENT, 100 - _TAIL_PERCENT])
    return float(np.maximum(np.maximum(low - places, places - high), 0).mean())


def _covered(points: Array, points_static: Array, axis: Array) -> float:
    """Share of the body's front that part (M, 3) and body (N, 3) cover together, seen across the panel."""
    across = _thin_direction(points, axis)
    up = np.cross(across, axis)
    plane = np.stack([axis, up], 1)
    low, high = np.percentile(points_static @ plane, [_TAIL_PERCENT, 100 - _TAIL_PERCENT], axis=0)
    cell = float((high - low).max()) / _CELLS
    depth = points @ across
    near = np.abs(points_static @ across - np.median(depth)) <= _FRONT_CELLS * cell + np.ptp(
        np.percentile(depth, [_TAIL_PERCENT, 100 - _TAIL_PERCENT])
    )
    places = np.concatenate([points, points_static[near]]) @ plane
    size = np.maximum(np.ceil((high - low) / cell).astype(int), 1)
    cells = np.floor((places - low) / cell).astype(int)
    cells = cells[np.all((cells >= 0) & (cells < size), axis=1)]
    return len(np.unique(cells, axis=0)) / float(size.prod())


def _thin_direction(points: Array, axis: Array) -> Array:
    """Unit direction (3,) across `axis` in which points (M, 3) extend least."""
    offsets = points - points.mean(0)
    flat = offsets - np.outer(offsets @ axis, axis)
    # The direction along the axis has no extent left and comes last.
    direction = np.linalg.svd(flat, full_matrices=False)[2][1]
    direction -= (direction @ axis) * axis
    return np.asarray(direction / np.linalg.norm(direction), np.float64)
