"""Candidates for an episode: grasp, arm configuration and approach, solved for all grasps at once."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from aomgen.core.plan import FittedAsset, Rejection
from aomgen.core.values import Array
from aomgen.episodes.grasps import Grasp, grasp_depths, grasps
from aomgen.episodes.ik import IkSolver, follow, walk
from aomgen.episodes.joint_limits import IkLimits
from aomgen.episodes.retarget import KNOTS, LEAVE, MOVE, NEAR, DemonstratedMotion, RetargetedMotion, Style
from aomgen.robots.robot import RobotModel

# Free motion: the demonstrated joints, shifted at both ends, or a path from a search.
Free = Literal["demonstrated", "searched"]
Way = tuple[Style, Free]
# Pairs of the motion near the handle and the free motion before it, in the order in which they are tried.
WAYS: Final[tuple[Way, ...]] = (
    ("demonstrated", "demonstrated"),
    ("straight", "demonstrated"),
    ("straight", "searched"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """One candidate for performing an episode.

    Attributes:
        motion: The end effector's motion with one grasp.
        joints: Arm joints (3, K, J) at the knots of approach, contact and retreat.
        free: Motion of the arm from the start to the approach.
    """

    motion: RetargetedMotion
    joints: Array
    free: Free

    @property
    def knots(self) -> Array:
        """Times of `joints` (3, K), [s]."""
        return self.motion.shown.knots[[NEAR, MOVE, LEAVE]]

    def __str__(self) -> str:
        return f"{self.motion.grasp.name}; {self.motion.style} approach, {self.free} free motion"


def list_motions(
    fitted: FittedAsset,
    shown: DemonstratedMotion,
    T_world_object: Array,
    robot: RobotModel,
    usual: Grasp | None = None,
) -> list[RetargetedMotion]:
    """List motions with all grasps that are tried, in the order of `grasps`."""
    demo = shown.demo
    depths = grasp_depths(fitted.asset, float(demo.grasp_ee[2]), robot)
    return [
        RetargetedMotion(shown=shown, fitted=fitted, T_world_object=T_world_object, grasp=grasp)
        for grasp in grasps(fitted, shown.hand_at_closed(fitted), depths, demo.ee_turn_ratio, usual)
    ]


def follow_contact(
    motions: Sequence[RetargetedMotion], arm: Array, solver: IkSolver, limits: IkLimits
) -> list[Array | Rejection]:
    """Solve joints (K, J) at the contact's knots for all grasps at once, in a configuration (J,)."""
    shown, fitted = motions[0].shown, motions[0].fitted
    times, order = shown.from_closed(fitted), int(np.sign(fitted.travel))
    targets = np.stack([motion.holding(times) for motion in motions], 1)
    joints = walk(solver, shown.poses(times[:1])[0], targets[0], arm)
    solved, reached = follow(solver, targets, joints, limits)
    return [
        solved[::order, k] if count == KNOTS else _reject("with the handle", count)
        for k, count in enumerate(reached)
    ]


def follow_sides(
    motions: Sequence[RetargetedMotion],
    contacts: Mapping[int, Array],
    way: Way,
    solver: IkSolver,
    limits: IkLimits,
) -> Iterator[tuple[int, Candidate | Rejection]]:
    """Yield candidates of all grasps with a solved contact, by number of the grasp."""
    if not contacts:
        return
    style, free = way
    styled = {k: replace(motions[k], style=style) for k in contacts}
    starts = np.stack([contacts[k][end] for end in (0, -1) for k in styled])
    to, off = (
        np.stack([motion.knots[row] for motion in styled.values()], 1) for row in (NEAR - 1, LEAVE - 1)
    )
    joints, reached = follow(solver, np.concatenate([to[::-1], off], 1), starts, limits)
    for number, (k, motion) in enumerate(styled.items()):
        went = number + len(styled)
        if reached[number] < KNOTS:
            yield k, _reject("back from the handle", reached[number])
        elif reached[went] < KNOTS:
            yield k, _reject("away from the handle", reached[went])
        else:
            path = np.stack([joints[::-1, number], contacts[k], joints[:, went]])
            path = unwind(path, motion.shown.demo.joints[0], solver.robot)
            yield k, Candidate(motion=motion, joints=path, free=free)


def unwind(joints: Array, start: Array, robot: RobotModel) -> Array:
    """Shift joints (..., K, J) by whole turns towards a start (J,) where the joint limits allow that."""
    turns = np.where(robot.slides, 0.0, np.round((start - joints[0, 0]) / (2 * np.pi)))
    turned, (low, high) = joints + 2 * np.pi * turns, robot.joint_limits.T
    return np.where(((turned > low) & (turned < high)).all((0, 1)), turned, joints)


def _reject(where: str, knots: int) -> Rejection:
    return Rejection(
        reason="unreachable",
        detail=f"the arm can follow the end effector {where} for {knots} of {KNOTS} poses",
        metrics={"path_share": knots / KNOTS},
    )
