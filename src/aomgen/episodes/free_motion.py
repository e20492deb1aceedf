"""Collision-free motion of the arm between two configurations: RRT-Connect of OMPL.

Source: Kuffner and LaValle, "RRT-Connect" (2000); Sucan, Moll and Kavraki, "The Open Motion Planning Library" (2012).
"""

from collections.abc import Callable
from itertools import count
from typing import Any, Final

import numpy as np
import ompl.base as ob
import ompl.geometric as og
from ompl import util

from aomgen.core.values import Array

# Configurations are sampled between start and goal, and this far beyond each joint's interval, [rad] or [m].
MARGIN: Final = 1.0
# Longest edge of a tree, and distance of the configurations checked along it, both as Euclidean distance of joints.
EDGE, RESOLUTION = 0.6, 0.06
# The search ends after this many steps: a narrow passage that needs more is cheaper to avoid with another grasp.
MAX_STEPS: Final = 400
# Passes over the path that shorten it. Each subdivision of the spline doubles its points.
SPLINE_PASSES: Final = 4


def find_free_path(
    start: Array, goal: Array, limits: Array, is_free: Callable[[Array], bool], seed: int
) -> Array | None:
    """Find joints (N, J) from `start` to `goal` (J,) without collisions, shortened and smoothed.

    Args:
        limits: Joint limits (J, 2).
        is_free: Function that returns whether a configuration (J,) has no collision.
        seed: Seed of the samples, at least 1; equal arguments give equal paths.

    Returns:
        The path; None where start or goal collides, or no path is found.

    Not checked: collisions between the tested configurations.
    """
    if not (is_free(start) and is_free(goal)):
        return None
    util.noOutputHandler()
    # OMPL seeds all generators that are created from here on, so that a path does not depend on earlier ones.
    util.RNG.setSeed(seed)
    size = len(start)
    ends = np.stack([start, goal])
    low = np.maximum(ends.min(0) - MARGIN, limits[:, 0])
    high = np.minimum(ends.max(0) + MARGIN, limits[:, 1])
    space, bounds = ob.RealVectorStateSpace(size), ob.RealVectorBounds(size)
    for joint in range(size):
        bounds.setLow(joint, float(low[joint]))
        bounds.setHigh(joint, float(high[joint]))
    space.setBounds(bounds)
    setup = og.SimpleSetup(space)
    # OMPL expects a fraction of the space's diagonal.
    space.setLongestValidSegmentFraction(RESOLUTION / space.getMaximumExtent())
    setup.setStateValidityChecker(lambda state: bool(is_free(_joints(state, size))))
    setup.setStartAndGoalStates(_state(space, start), _state(space, goal), 1e-9)
    planner = og.RRTConnect(setup.getSpaceInformation())
    planner.setRange(EDGE)
    setup.setPlanner(planner)
    steps = count()
    setup.solve(ob.PlannerTerminationCondition(lambda: next(steps) >= MAX_STEPS))
    if not setup.haveExactSolutionPath():
        return None
    path, simplifier = setup.getSolutionPath(), og.PathSimplifier(setup.getSpaceInformation())
    simplifier.reduceVertices(path)
    simplifier.partialShortcutPath(path)
    simplifier.smoothBSpline(path, SPLINE_PASSES)
    return np.stack([_joints(state, size) for state in path.getStates()])


def _joints(state: Any, size: int) -> Array:
    return np.array([state[k] for k in range(size)])


def _state(space: Any, joints: Array) -> Any:
    state = space.allocState()
    for joint, value in enumerate(joints.tolist()):
        state[joint] = value
    return state
