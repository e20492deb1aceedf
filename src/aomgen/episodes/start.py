"""Where the arm begins when the object stands in the way of the demonstrated beginning."""

from typing import Final

import numpy as np

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import FittedAsset, Rejection
from aomgen.core.transforms import interpolate, invert
from aomgen.core.values import Array
from aomgen.episodes.ik import IkSolver, follow
from aomgen.episodes.joint_limits import IkLimits
from aomgen.simulation.collision_check import KinematicLimits, check_kinematics
from aomgen.simulation.scene import Scene

# By how much the hand begins higher than demonstrated, the lowest that is free, [m].
RAISED_M: Final = (0.0, 0.1, 0.2, 0.3)
# Poses from the demonstrated start to another one, so that the arm stays on its branch.
STEPS: Final = 12


def choose_start(
    demo: Demonstration,
    fitted: FittedAsset,
    scene: Scene,
    T_world_object: Array,
    solver: IkSolver,
    limits: IkLimits,
    kinematic: KinematicLimits,
) -> Array:
    """Arm joints (J,) to begin with: the demonstrated ones, or when they are blocked others nearby.

    The hand begins where it was demonstrated, or where it was as seen from the object, and is raised until it is
    free. The demonstrated ones when nothing is.
    """
    start, gripper, there = demo.joints[0], demo.gripper[:1], demo.Ts_world_ee[0]

    def is_free(joints: Array) -> bool:
        theta, held = np.array([fitted.start_theta]), np.zeros(1, bool)
        result = check_kinematics(scene, joints[None], gripper, theta, held, kinematic)
        return not isinstance(result, Rejection)

    if is_free(start):
        return start
    carried = T_world_object @ invert(fitted.T_world_asset) @ there
    for raised in RAISED_M:
        for T in (carried, there):
            goal = T.copy()
            goal[2, 3] += raised
            way = interpolate(there, goal, np.linspace(0, 1, STEPS))[:, None]
            joints, reached = follow(solver, way, start[None], limits)
            if reached[0] == STEPS and is_free(joints[-1, 0]):
                return joints[-1, 0]
    return start
