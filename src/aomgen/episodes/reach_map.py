"""Where the arm can hold a handle along the whole contact: a map over the places and turns of an object."""

from dataclasses import dataclass
from itertools import chain, product
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import FittedAsset, Variation
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.episodes.candidates import list_motions
from aomgen.episodes.ik import IkSolver, find_arms, follow, walk
from aomgen.episodes.planning import PlanParams
from aomgen.episodes.retarget import DemonstratedMotion
from aomgen.episodes.variations import Range, Ranges, scale_fit
from aomgen.robots.robot import longest_reach

# Nodes are so far apart, [m] and [deg], or as far as so many nodes along each axis need.
PITCH_M, PITCH_DEG, MAX_NODES = 0.05, 15.0, 7
# Name of an asset's map in the stage's folder, with the asset's number.
REACH_MAP: Final = "reach_{:02d}"
# Grasps that are tried with other configurations of the arm: the map is coarse, and they are alike.
OTHER_GRASPS: Final = 6
# Poses of the contact that are looked at: some 10 cm of a handle's way apart.
POSES: Final = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class ReachMap:
    """Nodes of a grid over the places and turns of draws, and at which of them the arm can hold the handle.

    Attributes:
        x, y: As in `Variation`, [m].
        yaw: [rad].
        reached: (X, Y, W).
        places_world: Where the middle of the object's footprint is at each node, [m].
    """

    x: Annotated[Array, "X"]
    y: Annotated[Array, "Y"]
    yaw: Annotated[Array, "W"]
    reached: Annotated[NDArray[np.bool_], "X Y W"]
    places_world: Annotated[Array, "X Y 2"]

    __post_init__ = freeze_arrays

    def may_reach(self, variation: Variation) -> bool:
        """Whether the arm can hold the handle at any node about a draw, or the draw lies beside the map."""
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
    """Follow the contact at every node with every grasp that planning tries, on the demonstrated configuration of the arm.

    Where none reaches, other configurations are tried with some of the grasps.

    Args:
        fitted: Its size is the middle of the range of sizes.

    Not checked: collisions, the way to the handle and back, joint margins, speed.
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
        # Nodes that no arm and no grasp before has reached.
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
