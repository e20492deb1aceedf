"""Obstacles within the robot's reach other than the object, as upright boxes, and the free rectangle of the table.

Opaque Gaussians fill cells of a grid on the table. Boxes are fitted to connected cells that touch the table or extend below it;
floating and flat components are ignored.
"""

from collections.abc import Iterator
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_closing, label
from scipy.spatial import cKDTree

from aomgen.core.boxes import OrientedBox, find_upright_axes
from aomgen.core.demonstration import SupportPlane
from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import apply, matrix_from_quat, transform
from aomgen.core.values import Array
from aomgen.replacement.removal import Cleared
from aomgen.robots.robot import Reach, RobotConfiguration
from aomgen.twin.plan_view import PlanView
from aomgen.twin.support import Support

# Lower objects do not obstruct a gripper and cannot be distinguished from noise of the surface, [m].
LOWEST_M: Final = 0.015
# Side of a grid cell, [m]; gaps of this size are closed.
CELL_M: Final = 0.02
# Area of opaque surface for each sample, [m^2]; a cell that a surface crosses has about sixteen samples.
SAMPLE_M2: Final = 2.5e-5
# Distance by which an obstacle may be farther away than the arm reaches, [m]: the arm still touches its front.
BEHIND_M: Final = 0.3
# Largest radius of a Gaussian's disc, [m]: larger ones belong to the distant background.
LARGEST_M: Final = 0.1
# Least number of samples of a solid cell.
SOLID_SAMPLES: Final = 8
# Largest height of the lower end of an obstacle above the table, [m]; the hidden part of its foot is seldom higher.
FOOT_M: Final = 0.06
# Smallest number of cells of an obstacle, seen from above: a computer mouse covers about fifteen.
LEAST_CELLS: Final = 8
# Gaussians within this distance of the scanned robot belong to it or to its shadow, [m].
ROBOT_M: Final = 0.04
# Distance between boxes and the recorded robot, [m]: the robot moved there freely, and boxes exceed the visible surfaces.
CLEAR_M: Final = 0.01
# Number of points on the robot's surface: one every 1.5 cm.
ROBOT_SAMPLES: Final = 5000
# Gaussians within this distance of the object's location belong to the object, [m].
OBJECT_M: Final = 0.03
# A part of fewer cells is kept if it is higher, [m]: the foot of a lamp and its pole are different parts.
POLE_M: Final = 0.06
# Smallest side of a box, [m].
THINNEST_M: Final = CELL_M / 2
# A box is split in two if that reduces the volume by this share.
SAVED_SHARE: Final = 0.15
# Share of the samples beyond a side of a box that count as outliers.
BEYOND: Final = 0.01
# Distance around the object within which the table and its free rectangle are searched, [m].
TABLE_REACH_M = 1.0
# Cell size of the image in which the table is found, and of the grid on which the free rectangle grows, [m]: finer than the
# required accuracy of the outline.
TABLE_CELL_M, FREE_CELL_M = 0.01, 0.02
# Cells with less accumulated alpha are unobserved.
SURFACE_ALPHA = 0.15
# Largest number of adjacent cells of a hole between Gaussians that is closed, and of hidden cells in a strip that counts as free.
GAP_CELLS = 3


def find_obstacles(
    surroundings: Gaussians,
    support: Support,
    reach: Reach,
    configuration: RobotConfiguration,
) -> tuple[OrientedBox, ...]:
    """Cover obstacles within reach by boxes, from the table upwards; tall obstacles are cut at the limit of the reach.

    Args:
        surroundings: Static Gaussians without the object, world frame.
        support: The table below the object.
        configuration: Robot as scanned.
    """
    far_m, rng = reach.reach_m + BEHIND_M, np.random.default_rng(0)
    away = np.linalg.norm(surroundings.means - reach.shoulder_world, axis=1)
    points = _samples(surroundings.select(away < far_m + LARGEST_M), rng)
    plane = support.coordinates(points)
    kept = (plane[:, 2] > LOWEST_M) & (np.linalg.norm(points - reach.shoulder_world, axis=1) < far_m)
    kept &= ~((support.beyond_reach(plane[:, :2]) < OBJECT_M) & (plane[:, 2] < support.top + OBJECT_M))
    points, plane = points[kept], plane[kept]
    robot = configuration.surface_world(ROBOT_SAMPLES, rng)
    own, _ = cKDTree(robot).query(points, distance_upper_bound=ROBOT_M)
    plane = plane[np.isinf(own)]
    parts = (part for obstacle in _standing(plane) for part in _parts(obstacle))
    boxes = (_beside(_box(part, support.T_world_plane), robot) for part in parts)
    return tuple(box for box in boxes if box is not None)


def _samples(gaussians: Gaussians, rng: np.random.Generator) -> Array:
    """Sample points (N, 3) on the discs of Gaussians, in proportion to their area and opacity."""
    order = np.argsort(-gaussians.scales, axis=1)[:, :2]
    rows = np.arange(len(gaussians))
    sizes = np.minimum(np.take_along_axis(gaussians.scales, order, 1).astype(np.float64), LARGEST_M)
    expected = np.pi * sizes.prod(1) * gaussians.opacities / SAMPLE_M2
    owners = np.repeat(rows, np.floor(expected + rng.uniform(size=len(rows))).astype(int))
    axes = matrix_from_quat(gaussians.quats.astype(np.float64))[rows[:, None], :, order] * sizes[..., None]
    radius, angle = np.sqrt(rng.uniform(size=len(owners))), rng.uniform(0, 2 * np.pi, len(owners))
    disc = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    return gaussians.means.astype(np.float64)[owners] + np.einsum("ni,nij->nj", disc, axes[owners])


def _standing(plane: Array) -> Iterator[Array]:
    """Yield the samples (N, 3) of each connected obstacle that stands on the table, plane frame."""
    if not len(plane):
        return
    low = np.append(plane[:, :2].min(0), LOWEST_M)
    cells = np.floor((plane - low) / CELL_M).astype(int)
    counts = np.zeros(cells.max(0) + 1, int)
    np.add.at(counts, tuple(cells.T), 1)
    components = np.zeros(counts.shape, np.int32)
    label(counts >= SOLID_SAMPLES, np.ones((3, 3, 3)), output=components)
    owners = components[tuple(cells.T)]
    for index in range(1, int(components.max()) + 1):
        columns = (components == index).any(2)
        foot = int(np.flatnonzero((components == index).any((0, 1)))[0]) * CELL_M
        if columns.sum() >= LEAST_CELLS and foot <= FOOT_M:
            yield plane[owners == index]


def _parts(obstacle: Array) -> list[Array]:
    """Split the samples (N, 3) of an obstacle into parts where two boxes are clearly smaller than one."""
    R = find_upright_axes(obstacle)
    turned = obstacle @ R
    cells = np.floor((turned[:, :2] - turned[:, :2].min(0)) / CELL_M).astype(int)
    heights, counts = np.zeros(cells.max(0) + 1), np.zeros(cells.max(0) + 1, int)
    np.maximum.at(heights, tuple(cells.T), obstacle[:, 2])
    np.add.at(counts, tuple(cells.T), 1)
    heights[counts < SOLID_SAMPLES] = 0.0
    # Few low cells are the blur beside a larger part, but few high ones are a pole.
    if np.count_nonzero(heights) < LEAST_CELLS and heights.max() < POLE_M:
        return []
    best, where = (1 - SAVED_SHARE) * _volume(heights), None
    for axis in (0, 1):
        for cut in range(1, heights.shape[axis]):
            volume = sum(_volume(half) for half in np.split(heights, [cut], axis))
            if volume < best:
                best, where = volume, (axis, cut)
    if where is None:
        return [obstacle]
    before = cells[:, where[0]] < where[1]
    return [*_parts(obstacle[before]), *_parts(obstacle[~before])]


def _volume(heights: Array) -> float:
    """Compute the volume of the box around columns (X, Y), in cells of the table times [m]."""
    rows, columns = heights.any(1), heights.any(0)
    if not rows.any():
        return 0.0
    return (
        float(np.ptp(np.flatnonzero(rows)) + 1) * float(np.ptp(np.flatnonzero(columns)) + 1) * heights.max()
    )


def _box(part: Array, T_world_plane: Array) -> OrientedBox:
    """Compute the box around samples (N, 3), from the table upwards, world frame."""
    R = find_upright_axes(part)
    low, high = np.quantile(part @ R, (BEYOND, 1 - BEYOND), axis=0)
    low[2] = 0.0
    T_plane_box = transform(R, R @ ((low + high) / 2))
    half = np.maximum(high - low, THINNEST_M) / 2
    return OrientedBox(T_world_box=T_world_plane @ T_plane_box, half_extents=half)


def _beside(box: OrientedBox, robot_world: Array) -> OrientedBox | None:
    """Cut from a box the part that contains points of the robot (N, 3), at the side or the top where the least is lost."""
    points, half = box.coordinates(robot_world), box.half_extents
    inside = points[(np.abs(points) < half + CLEAR_M).all(1)]
    if not len(inside):
        return box
    ends = np.stack([-half, half])
    cuts = [(1, axis, inside[:, axis].min() - CLEAR_M) for axis in range(3)]
    cuts += [(0, axis, inside[:, axis].max() + CLEAR_M) for axis in range(2)]
    end, axis, where = max(
        cuts, key=lambda cut: (2 * cut[0] - 1) * (cut[2] - ends[1 - cut[0], cut[1]]) / half[cut[1]]
    )
    ends[end, axis] = where
    if not (ends[0] < ends[1]).all():
        return None
    T = box.T_world_box @ transform(np.eye(3), ends.mean(0))
    return OrientedBox(T_world_box=T, half_extents=np.ptp(ends, 0) / 2)


def support_plane(cleared: Cleared) -> SupportPlane:
    """Compute the height of the cleared scene's table and its free rectangle around the recorded object, world frame, [m]."""
    support = cleared.support
    low, high = support.low - TABLE_REACH_M, support.high + TABLE_REACH_M
    plan = PlanView(support=support, low=low, high=high, cell=TABLE_CELL_M)
    world = cleared.twin.gaussians.select(cleared.twin.bodies == 0)
    xy = plan.xy[binary_closing(plan.cover(world) > SURFACE_ALPHA, iterations=GAP_CELLS)]
    xy_corners = [
        [x, y] for x in (support.low[0], support.high[0]) for y in (support.low[1], support.high[1])
    ]

    def in_world(plane_xy: Array) -> Array:
        return apply(support.T_world_plane, np.column_stack([plane_xy, np.zeros(len(plane_xy))]))[:, :2]

    footprint = in_world(np.array(xy_corners))
    free_low, free_high = free_rectangle(in_world(xy), footprint.min(0), footprint.max(0))
    return SupportPlane(height=float(support.T_world_plane[2, 3]), low_xy=free_low, high_xy=free_high)


def free_rectangle(surface_xy: ArrayLike, low: ArrayLike, high: ArrayLike) -> tuple[Array, Array]:
    """Grow a rectangle over the surface around an object, until it meets an edge or another object.

    Cells below other objects are empty, because the objects hide the surface, and stop the growth. The rectangle is therefore
    observed table without objects.

    Args:
        surface_xy: Points of the surface (N, 2), seen from above, [m].
        low, high: Corners (2,) of the object's footprint, which is assumed to be free, [m].
    """
    xy = np.asarray(surface_xy, np.float64)
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    origin = low - TABLE_REACH_M
    shape = np.ceil((high + TABLE_REACH_M - origin) / FREE_CELL_M).astype(int)
    cells = np.floor((xy - origin) / FREE_CELL_M).astype(int)
    inside = np.all((cells >= 0) & (cells < shape), axis=1)
    free = np.zeros(shape, bool)
    free[tuple(cells[inside].T)] = True
    start = np.floor((low - origin) / FREE_CELL_M).astype(int)
    end = np.ceil((high - origin) / FREE_CELL_M).astype(int)
    free[start[0] : end[0], start[1] : end[1]] = True
    growing = True
    while growing:
        growing = False
        for axis, (ends, step) in product((0, 1), ((start, -1), (end, 1))):
            strip = ends[axis] - 1 if step < 0 else ends[axis]
            across = slice(start[1 - axis], end[1 - axis])
            if 0 <= strip < shape[axis] and _longest_gap(free.take(strip, axis)[across]) <= GAP_CELLS:
                ends[axis] += step
                growing = True
    return origin + start * FREE_CELL_M, origin + end * FREE_CELL_M


def _longest_gap(free: NDArray[np.bool_]) -> int:
    """Count the cells of the longest run of cells that are not free."""
    edges = np.flatnonzero(np.concatenate([[True], free, [True]]))
    return int(np.diff(edges).max()) - 1
