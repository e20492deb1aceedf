"""Whether a demonstration opened or closed the object, from where its part was and where it went."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.core.joint import Joint
from aomgen.core.motion import Direction
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.motion.filters import close_gaps

# A part that leaves the body takes along at least this share of its travel; one that slides within it none.
_LEAVING_SHARE = 0.2
# Cells of a sliding panel along its longer side.
_CELLS = 12
# Points beyond this percentile on either side are strays, [%].
_TAIL_PERCENT = 2.0


def infer_direction(joint: Joint, theta: float, points_static: Array, points_moving: Array) -> Direction:
    """Open or close: what a part does that goes from its scanned place to joint value `theta`.

    A closed part is flush with the body: a door or lid lies on it, a drawer is inside of it. A panel
    that slides along the body is flush everywhere; it opens by going before (or behind) the body's own
    front, and closes by covering what was open.

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
    return "opening" if _lies_before_front(joint.axis, theta, points_static, points_moving) else "closing"


def _beyond(places: Array, body: Array) -> float:
    """How far places (M,) stick out of the range of the body's (N,) on average, [m]."""
    low, high = np.percentile(body, [_TAIL_PERCENT, 100 - _TAIL_PERCENT])
    return float(np.maximum(np.maximum(low - places, places - high), 0).mean())


def _lies_before_front(axis: Array, travel_m: float, points_static: Array, points: Array) -> bool:
    """Whether most of what a panel (M, 3) newly covers after its travel was the body's (N, 3) front already.

    What it uncovers does not count: the scan could not see what was behind it.
    """
    across = _thin_direction(points, axis)
    plane = np.stack([axis, np.cross(across, axis)], 1)
    low, high = np.percentile(points @ plane, [_TAIL_PERCENT, 100 - _TAIL_PERCENT], axis=0)
    cell = float((high - low).max()) / _CELLS
    depth = points @ across
    # Two panels run within a cell of each other; a handle does not make the panel thicker.
    near = np.abs(points_static @ across - np.median(depth)) <= cell + np.ptp(np.percentile(depth, [25, 75]))
    shift = np.array([travel_m, 0.0])
    size = np.maximum(np.ceil((high - low + np.abs(shift)) / cell).astype(int), 1)
    low = low + np.minimum(shift, 0.0)

    def covered(places: Array) -> NDArray[np.bool_]:
        cells = np.floor((places - low) / cell).astype(int)
        cells = cells[np.all((cells >= 0) & (cells < size), axis=1)]
        grid = np.zeros(size, bool)
        grid[tuple(cells.T)] = True
        return close_gaps(grid, 1)

    start, end = (covered(points @ plane + offset) for offset in (0.0, shift))
    fresh = end & ~start
    return float(covered(points_static[near] @ plane)[fresh].mean()) >= 0.5 if fresh.any() else True


def _thin_direction(points: Array, axis: Array) -> Array:
    """Unit direction (3,) across `axis` in which points (M, 3) extend least."""
    offsets = points - points.mean(0)
    flat = offsets - np.outer(offsets @ axis, axis)
    # The direction along the axis has no extent left and comes last.
    direction = np.linalg.svd(flat, full_matrices=False)[2][1]
    direction -= (direction @ axis) * axis
    return np.asarray(direction / np.linalg.norm(direction), np.float64)
