"""Reach map: poses of an object at which the arm can hold its handle along the whole contact; drawn as SVG."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain, product
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from aomgen.core.demonstration import Demonstration, EpisodeScene
from aomgen.core.plan import FittedAsset, Variation
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.episodes.candidates import list_motions
from aomgen.episodes.ik import IkSolver, find_arms, follow, walk
from aomgen.episodes.planning import PlanParams
from aomgen.episodes.retarget import DemonstratedMotion
from aomgen.episodes.variations import Range, Ranges, scale_fit
from aomgen.robots.robot import longest_reach

# Spacing of nodes, [m] and [deg], and the largest number of nodes along each axis.
PITCH_M, PITCH_DEG, MAX_NODES = 0.05, 15.0, 7
# Name of an asset's map in the stage's folder, with the asset's number.
REACH_MAP: Final = "reach_{:02d}"
# Number of grasps tried with other configurations of the arm: the map is coarse, and grasps are similar.
OTHER_GRASPS: Final = 6
# Number of poses of the contact: about 10 cm of a handle's path apart.
POSES: Final = 5
# Width of a map, [px], and margin around its content, [m].
WIDTH, ROOM_M = 480, 0.08
# Length of a line in the direction of an object's front, [m].
LINE_M: Final = 0.06
OUTCOMES: Final = {"committed": "#2c7a4b", "rejected": "#d1495b", "skipped": "#b9c2cf"}
TABLE, OBSTACLE, REACHED = "#f3ead9", "#8a8f98", "#57b894"
# Opacity of a location that the arm reaches for every yaw, 0..1.
REACHED_OPACITY: Final = 0.7
# Half the side of the square of a location without neighbors, [m].
LEAST_HALF_M: Final = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class ReachMap:
    """Grid over the positions and yaws of draws, with the nodes at which the arm can hold the handle.

    Attributes:
        x, y: See `Variation`, [m].
        yaw: [rad].
        reached: (X, Y, W).
        places_world: Center of the object's footprint at each node, [m].
    """

    x: Annotated[Array, "X"]
    y: Annotated[Array, "Y"]
    yaw: Annotated[Array, "W"]
    reached: Annotated[NDArray[np.bool_], "X Y W"]
    places_world: Annotated[Array, "X Y 2"]

    __post_init__ = freeze_arrays

    def may_reach(self, variation: Variation) -> bool:
        """Return whether the arm holds the handle at any node around a draw, or the draw is off the map."""
        cell = []
        for nodes, value in ((self.x, variation.x), (self.y, variation.y), (self.yaw, variation.yaw)):
            after = int(np.searchsorted(nodes, value))
            if not nodes[0] <= value <= nodes[-1]:
                return True
            cell.append(slice(max(after - 1, 0), after + 1))
        return bool(self.reached[tuple(cell)].any())


def map_reach(
    fitted: FittedAsset,
    demo: Demonstration,
    ranges: Ranges,
    solver: IkSolver,
    params: PlanParams,
    *,
    max_nodes: int = MAX_NODES,
) -> ReachMap:
    """Follow the contact at every node with every grasp, in the demonstrated arm configuration.

    Where none reaches, other configurations are tried with some of the grasps.

    Args:
        fitted: The asset at its fitted size; the map is computed for the middle of `ranges.scale`.

    Not checked: collisions, the motion to the handle and back, joint margins, speed.
    """
    fitted = scale_fit(fitted, sum(ranges.scale) / 2)
    shown = DemonstratedMotion(demo)
    motions = list_motions(fitted, shown, np.eye(4), solver.robot)
    knots = shown.from_closed(fitted)
    times = knots[np.linspace(0, len(knots) - 1, POSES).round().astype(int)]
    Ts_object_ee = np.stack([motion.holding(times) for motion in motions])
    x, y = (_nodes(bounds, PITCH_M, max_nodes) for bounds in ranges.place_bounds)
    yaw = _nodes(ranges.yaw_deg, PITCH_DEG, max_nodes)
    grid = np.stack(np.meshgrid(x, y, np.deg2rad(yaw), indexing="ij"), -1)
    Ts_world_object = np.stack(
        [
            Variation(seed=0, index=0, x=x, y=y, yaw=yaw, frame=ranges.frame).place_at(fitted)
            for x, y, yaw in grid.reshape(-1, 3).tolist()
        ]
    )
    T_world_from, start = shown.poses(times[:1])[0], shown.joints(times[:1])[0]
    reach, handles = longest_reach(solver.robot), apply(Ts_world_object, fitted.contact_asset[None])
    near = np.linalg.norm(handles - reach.shoulder_world, axis=1) <= reach.reach_m
    reached = np.zeros(len(Ts_world_object), bool)
    first, *others = find_arms(solver, T_world_from, start, params.ik)
    some = Ts_object_ee[:: max(1, len(Ts_object_ee) // OTHER_GRASPS)]
    for arm, Ts in chain(product([first], Ts_object_ee), product(others, some)):
        # Nodes that no earlier arm configuration and grasp has reached.
        left = np.flatnonzero(near & ~reached)
        if not len(left):
            break
        targets = Ts_world_object[left] @ Ts[:, None]
        joints = walk(solver, T_world_from, targets[0], arm)
        _, counts = follow(solver, targets, joints, params.ik)
        reached[left] = counts == POSES
    places = apply(Ts_world_object, fitted.middle_asset[None])[:, :2].reshape(*grid.shape[:3], 2)
    return ReachMap(
        x=x, y=y, yaw=np.deg2rad(yaw), reached=reached.reshape(grid.shape[:3]), places_world=places[:, :, 0]
    )


def _nodes(bounds: Range, pitch: float, most: int) -> Array:
    low, high = bounds
    nodes = np.linspace(low, high, min(1 + int(np.ceil((high - low) / pitch)), most))
    return np.asarray(nodes, np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """A polygon (N, 2) or, with `dot`, a line with a dot at its first point; world frame, [m]."""

    points_world: Annotated[Array, "_ 2"]
    color: str
    opacity: float = 1.0
    outline: bool = False
    dot: bool = False

    __post_init__ = freeze_arrays


def scene_shapes(scene: EpisodeScene, maps: Sequence[ReachMap]) -> list[Shape]:
    """List the known table, the reached locations (opaque for many yaws and maps), and obstacles."""
    shapes = []
    low, high = scene.support.low_xy, scene.support.high_xy
    if np.isfinite([low, high]).all():
        corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
        shapes.append(Shape(points_world=corners, color=TABLE))
    for found in maps:
        shapes += _mark_reached_places(found, REACHED_OPACITY / len(maps))
    for box in scene.obstacles:
        corners = box.corners()[:, :2]
        shapes.append(Shape(points_world=corners[ConvexHull(corners).vertices], color=OBSTACLE))
    return shapes


def draw_map(shapes: Iterable[Shape]) -> str:
    """Draw shapes, the last on top; the robot's base is a cross at the origin, x points right, y up."""
    shapes = list(shapes)
    points = np.concatenate([np.zeros((1, 2)), *(shape.points_world for shape in shapes)])
    low, high = points.min(0) - ROOM_M, points.max(0) + ROOM_M
    scale = WIDTH / (high[0] - low[0])
    height = scale * (high[1] - low[1])

    def at(point: Array) -> str:
        return f"{scale * (point[0] - low[0]):.1f},{height - scale * (point[1] - low[1]):.1f}"

    drawn = []
    for shape in shapes:
        corners = " ".join(map(at, shape.points_world))
        if shape.dot:
            drawn.append(
                f'<polyline points="{corners}" stroke="{shape.color}" stroke-width="2" fill="none"/>'
                f'<circle r="3" fill="{shape.color}" transform="translate({at(shape.points_world[0])})"/>'
            )
        elif shape.outline:
            drawn.append(f'<polygon points="{corners}" fill="none" stroke="{shape.color}" stroke-width="2"/>')
        else:
            drawn.append(
                f'<polygon points="{corners}" fill="{shape.color}" fill-opacity="{shape.opacity:.2f}"/>'
            )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:.0f}" style="max-width:{WIDTH}px">'
        f'{"".join(drawn)}<path d="M{at(np.zeros(2))}m-7,0h14m-7,-7v14" stroke="#1c2430" stroke-width="2"/></svg>'
    )


def front_line(fitted: FittedAsset, variation: Variation, outcome: str) -> Shape:
    """Make a line from the center of an object to before its front, in the color of its draw's outcome."""
    fitted = scale_fit(fitted, variation.scale)
    ends = np.stack([fitted.middle_asset, fitted.middle_asset - [0.0, LINE_M, 0.0]])
    return Shape(
        points_world=apply(variation.place_at(fitted), ends)[:, :2], color=OUTCOMES[outcome], dot=True
    )


def _mark_reached_places(found: ReachMap, opacity: float) -> list[Shape]:
    """Make a square around each location that is reached for some yaw."""
    places, shares = found.places_world, found.reached.mean(2)
    gaps = [np.linalg.norm(np.diff(places, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    half = min((gap[gap > 0].min() / 2 for gap in gaps if (gap > 0).any()), default=LEAST_HALF_M)
    square = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return [
        Shape(points_world=place + square, color=REACHED, opacity=opacity * share)
        for place, share in zip(places.reshape(-1, 2), shares.ravel(), strict=True)
        if share > 0
    ]
