"""From a hand motion to arm joints: the grasp first, then backwards to the start and on to the end.

Solving outwards from the grasp keeps the demonstration's branch of the arm where it matters.
"""

from typing import Literal

import numpy as np

from aomgen.core.demonstration import Demonstration
from aomgen.core.transforms import interpolate
from aomgen.core.values import Array
from aomgen.core.verdict import Rejection
from aomgen.generalization.ik import IkLimits, IkPath, IkSolver, solve_path
from aomgen.generalization.retarget import CONTACT, HandMotion

# The free way to the object: straight in space as the paper has it, or smooth in the joints,
# which no singular pose can spoil.
FreeWay = Literal["cartesian", "joints"]
# The Cartesian way has to end where the demonstration began, on the same branch, [rad].
START_TOLERANCE_RAD = 0.05
# Poses between the demonstrated grasp and the new one: near enough to each other to stay on the branch.
SEED_STEPS = 12


def solve_contact(
    solver: IkSolver, motion: HandMotion, demo: Demonstration, limits: IkLimits
) -> IkPath | Rejection:
    """Arm joints of the contact frames, on the demonstration's branch."""
    contact = np.flatnonzero(motion.phases == CONTACT)
    demo_times = demo.times_s - demo.times_s[0]
    nearest = int(np.argmin(np.abs(demo_times - motion.demo_times_s[contact[0]])))
    # Walk from the demonstrated grasp to the new one, so that the branch is the same.
    there = interpolate(
        demo.Ts_world_ee[nearest], motion.Ts_world_ee[contact[0]], np.linspace(0, 1, SEED_STEPS)
    )
    seed = solve_path(solver, there, demo.joints[nearest], limits)
    if isinstance(seed, Rejection):
        # Part of that walk may be out of reach although its end is not.
        start = demo.joints[nearest]
    else:
        start = seed.joints[-1]
    return solve_path(solver, motion.Ts_world_ee[contact], start, limits)


def solve_around(
    solver: IkSolver,
    motion: HandMotion,
    contact_path: IkPath,
    demo: Demonstration,
    free_way: FreeWay,
    limits: IkLimits,
) -> IkPath | Rejection:
    """Arm joints of the whole motion, given those of its contact frames.

    Args:
        solver: The arm.
        motion: The hand.
        contact_path: From `solve_contact` for the same motion.
        demo: The demonstration; its start is the start.
        free_way: How to get from there to where the hand moves with the object.
        limits: Acceptance.

    Returns:
        The path; or a Rejection "unreachable", "joint_limit" or "branch" (the way back from the
        grasp does not end in the demonstrated start pose).
    """
    contact = np.flatnonzero(motion.phases == CONTACT)
    first, last = contact[0], contact[-1]
    joints = np.empty((len(motion.thetas), contact_path.joints.shape[1]))
    joints[contact] = contact_path.joints
    residuals = [(contact_path.residual_mm, contact_path.residual_deg)]
    free = 0
    if free_way == "joints":
        free = int(np.searchsorted(motion.blend[:first], 1.0 - 1e-9))
    pieces = [(np.arange(last + 1, len(joints)), contact_path.joints[-1])]
    pieces.append((np.arange(first - 1, free - 1, -1), contact_path.joints[0]))
    for rows, start in pieces:
        path = solve_path(solver, motion.Ts_world_ee[rows], start, limits)
        if isinstance(path, Rejection):
            return path
        joints[rows] = path.joints
        residuals.append((path.residual_mm, path.residual_deg))
    if free_way == "joints":
        joints[:free] = _free_joints(motion, demo, joints[free], free)
    elif not np.abs(joints[0] - demo.joints[0]).max() <= START_TOLERANCE_RAD:
        return Rejection(
            reason="branch",
            detail="the way back from the grasp does not end in the demonstrated start pose",
            metrics={"start_error_rad": float(np.abs(joints[0] - demo.joints[0]).max())},
        )
    worst = np.max(residuals, axis=0)
    return IkPath(joints=joints, residual_mm=float(worst[0]), residual_deg=float(worst[1]))


def _free_joints(motion: HandMotion, demo: Demonstration, goal: Array, free: int) -> Array:
    """The demonstrated joints, bent so that they end in `goal`: joints (free, J)."""
    times = demo.times_s - demo.times_s[0]

    def demonstrated(at: Array) -> Array:
        return np.stack([np.interp(at, times, column) for column in demo.joints.T], -1)

    old = demonstrated(motion.demo_times_s[:free])
    bend = goal - demonstrated(motion.demo_times_s[free : free + 1])[0]
    return old + motion.blend[:free, None] * bend
