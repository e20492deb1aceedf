"""Pushes that carry the arm off its plan before the contact: demonstrations then show how to recover.

Only the command of the simulated arm differs; the actions of the episode remain the plan's next targets.
A policy that learns from plans alone never observes the results of its errors. Source: Laskey et al.,
DART (2017), for the idea.
"""

from typing import Final

import numpy as np

from aomgen.core.plan import EpisodePlan
from aomgen.core.values import Array
from aomgen.episodes.ik import IkSolver
from aomgen.episodes.retarget import CONTACT

# Duration of a push, and the least time between its end and the beginning of the contact, [s].
PUSH_S, CALM_S = 1.0, 0.5
# Damping of the pseudo-inverse from end effector displacement to joints, [m]:
# near singular poses it moves less.
DAMPING: Final = 0.05


def push_joints(plan: EpisodePlan, solver: IkSolver) -> Array:
    """Add smooth offsets of up to `variation.push_m` to the plan's joints (T, J) before the contact."""
    variation, joints = plan.variation, plan.joints.copy()
    frames, each = int(np.argmax(plan.phases == CONTACT)) - round(CALM_S * plan.fps), round(PUSH_S * plan.fps)
    count = max(frames, 0) // each
    if variation.push_m == 0 or not count:
        return joints
    rng = np.random.default_rng([variation.seed, variation.index, count])
    ways = rng.normal(size=(count, 3))
    ways *= variation.push_m * rng.random((count, 1)) / np.linalg.norm(ways, axis=1, keepdims=True)
    shape = np.sin(np.pi * np.arange(each) / each) ** 2
    offsets = (ways[:, None] * shape[:, None]).reshape(-1, 3)
    _, jacobians = solver.kinematics(joints[: len(offsets)])
    steps = np.concatenate([offsets, np.zeros_like(offsets)], 1)
    J = jacobians
    square = J @ J.transpose(0, 2, 1) + DAMPING**2 * np.eye(6)
    joints[: len(offsets)] += (J.transpose(0, 2, 1) @ np.linalg.solve(square, steps[..., None]))[..., 0]
    return joints
