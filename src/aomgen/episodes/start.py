"""Start of the arm when the object blocks the demonstrated start."""

from collections.abc import Callable
from typing import Final

import numpy as np

from aomgen.core.transforms import interpolate
from aomgen.core.values import Array
from aomgen.episodes.ik import IkSolver, follow
from aomgen.episodes.joint_limits import IkLimits

# Heights above the demonstrated start that are tried, the lowest free one is taken, [m].
RAISED_M: Final = (0.0, 0.1, 0.2, 0.3)
# Number of poses between the given pose and a start, so that the arm keeps its configuration.
STEPS: Final = 12


def find_start(
    Ts_start: Array,
    T_from: Array,
    joints: Array,
    solver: IkSolver,
    limits: IkLimits,
    is_free: Callable[[Array], bool],
) -> Array | None:
    """Find arm joints (J,) at the first collision-free of some poses, or above it; None if there is none.

    Args:
        Ts_start: Poses (N, 4, 4) at which the end effector may begin.
        T_from, joints: A pose (4, 4) and the arm's joints (J,) there, whose configuration is kept.
        is_free: Function that returns whether joints (J,) have no collision.
    """
    goals = np.repeat(Ts_start[None], len(RAISED_M), 0)
    goals[..., 2, 3] += np.array(RAISED_M)[:, None]
    shares = np.linspace(0, 1, STEPS)
    steps = np.stack([interpolate(T_from, goal, shares) for goal in goals.reshape(-1, 4, 4)], 1)
    found, reached = follow(solver, steps, np.repeat(joints[None], steps.shape[1], 0), limits)
    free = (found[-1, k] for k in np.flatnonzero(reached == STEPS) if is_free(found[-1, k]))
    return next(free, None)
