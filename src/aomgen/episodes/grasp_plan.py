"""The plan of an episode with one grasp: the arm's joints along it, its speed, what it touches.

The arm is solved first where it holds the closed part, then from there to the start and to the end: that keeps the
demonstration's branch of the arm where it matters.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from aomgen.core.episode import PHASES
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation
from aomgen.core.values import Array
from aomgen.episodes.ik import IkSolver, follow, solve_smoothly, walk
from aomgen.episodes.joint_limits import IkLimits, IkPath, check_speed
from aomgen.episodes.retarget import (
    CONTACT,
    KNOTS,
    DemonstratedMotion,
    FreeWay,
    HandMotion,
    RetargetedMotion,
    free_joints,
)
from aomgen.simulation.collision_check import KinematicLimits, check_kinematics, stalling_gripper
from aomgen.simulation.scene import Scene

# The Cartesian way has to end where the demonstration began, on the same branch, [rad].
START_TOLERANCE_RAD = 0.05
# A motion that is too fast is made this much slower than needed, as a factor: sampling shifts its peaks.
SLOWER = 1.05
Method = Literal["aomgen", "paper"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanParams:
    """How an episode is planned.

    Attributes:
        fps: Samples a second.
        ik: Limits of the arm.
        kinematic: Limits of tier A.
        max_slow_down: How much slower than asked a phase of a too fast plan may become: films may begin near the handle.
        method: "aomgen", or "paper" to compare: the demonstrated contact turned with the object, straight ways beside it.
    """

    fps: float = 10.0
    ik: IkLimits = field(default_factory=IkLimits)
    kinematic: KinematicLimits = field(default_factory=KinematicLimits)
    max_slow_down: float = 5.0
    method: Method = "aomgen"


class PlanTask(NamedTuple):
    """What all grasps of one variation share; `start` are the arm's first joints (J,)."""

    shown: DemonstratedMotion
    variation: Variation
    fitted: FittedAsset
    placed: Scene
    solver: IkSolver
    params: PlanParams
    start: Array


class ArmPath(NamedTuple):
    """Joints (3 K, J) at the knots of approach, contact and retreat; why the hand cannot come or go, if it cannot."""

    joints: Array
    lost: Rejection | None


def follow_contact(task: PlanTask, motions: list[RetargetedMotion]) -> list[Array | Rejection]:
    """Joints (K, J) at the knots of the contact, for all grasps at once, on the demonstration's branch."""
    shown, order = task.shown, int(np.sign(task.fitted.travel))
    times = shown.from_closed(task.fitted)
    targets = np.stack([motion.holding(times) for motion in motions], 1)
    joints = walk(task.solver, shown.poses(times[:1])[0], targets[0], shown.joints(times[:1])[0])
    solved, reached = follow(task.solver, targets, joints, task.params.ik)
    return [
        solved[::order, k] if count == KNOTS else _lost("with the handle", count)
        for k, count in enumerate(reached)
    ]


def follow_sides(
    task: PlanTask, motions: Mapping[int, RetargetedMotion], held: Mapping[int, Array]
) -> dict[int, ArmPath]:
    """Arm joints before and after the contact, for all grasps at once, away from where the hand holds."""
    if not motions:
        return {}
    starts = np.stack([held[k][end] for end in (0, -1) for k in motions])
    to = np.stack([motion.knots[0][::-1] for motion in motions.values()], 1)
    off = np.stack([motion.knots[4] for motion in motions.values()], 1)
    joints, reached = follow(task.solver, np.concatenate([to, off], 1), starts, task.params.ik)
    arms = {}
    for number, k in enumerate(motions):
        went = len(motions) + number
        lost = "back from the handle to the start" if reached[number] < KNOTS else "away from the handle"
        least = min(reached[number], reached[went])
        arms[k] = ArmPath(
            np.concatenate([joints[::-1, number], held[k], joints[:, went]]),
            None if least == KNOTS else _lost(lost, least),
        )
    return arms


def _lost(where: str, knots: int) -> Rejection:
    return Rejection(
        reason="unreachable",
        detail=f"the arm can follow the hand {where} for {knots} of {KNOTS} poses",
        metrics={"path_share": knots / KNOTS},
    )


def plan_with(
    task: PlanTask, motion: RetargetedMotion, arm: ArmPath, free: FreeWay
) -> EpisodePlan | Rejection:
    """The episode with one grasp and one way; a motion that is only too fast is tried again more slowly."""
    params, slow_down = task.params, np.ones(len(PHASES))
    if arm.lost is not None and free == "cartesian":
        return arm.lost
    while True:
        sampled = motion.sample(params.fps, speed=task.variation.speed, slow_down=slow_down)
        path = _solve(task, sampled, arm, free)
        if isinstance(path, Rejection):
            return path
        rates = check_speed(path.joints, params.fps, params.ik, task.placed.robot.slides, sampled.phases)
        if not isinstance(rates, Rejection):
            break
        needed = np.array([rates.metrics[f"{phase}_share"] for phase in PHASES])
        slow_down *= np.where(needed > 1.0, SLOWER * needed, 1.0)
        if not slow_down.max() <= params.max_slow_down:
            in_contact = float(slow_down[CONTACT] > params.max_slow_down)
            return replace(rates, metrics={**rates.metrics, "in_contact": in_contact})
    figures = _check_motion(task, sampled, path.joints, motion.held_at)
    if isinstance(figures, Rejection):
        return _located(figures, sampled)
    lifted = f", raised {motion.lift:.2f} m" if motion.lift else ""
    return EpisodePlan(
        variation=task.variation,
        fitted=task.fitted,
        T_world_object=motion.T_world_object,
        fps=params.fps,
        joints=path.joints,
        gripper=sampled.gripper,
        thetas=sampled.thetas,
        phases=sampled.phases,
        Ts_world_ee=task.placed.robot.ee_poses(path.joints),
        grasp=f"{motion.grasp.name}; {free} way, {motion.approach} approach, {motion.retreat} retreat{lifted}",
        metrics={**figures, **rates, "residual_mm": path.residual_mm, "residual_deg": path.residual_deg},
    )


def _solve(task: PlanTask, motion: HandMotion, arm: ArmPath, free_way: FreeWay) -> IkPath | Rejection:
    """Arm joints of the whole motion, from those at its knots.

    Returns:
        The path; or a Rejection "unreachable", "joint_limit" or "branch" (the way back from the
        grasp does not end in the start pose).
    """
    knots = task.shown.knots[[0, 2, 4]].ravel()
    guesses = np.stack([np.interp(motion.demo_times_s, knots, q) for q in arm.joints.T], 1)
    # Rows before this one are free.
    free = 0 if free_way == "cartesian" else int(np.searchsorted(motion.blend, 1.0 - 1e-9))
    start = task.start if free_way == "cartesian" else None
    poses, params = motion.Ts_world_ee[free:], task.params
    path = solve_smoothly(task.solver, poses, guesses[free:], params.fps, params.ik, start)
    if isinstance(path, Rejection):
        return _located(path, motion, free)
    if free_way != "cartesian":
        joints = free_joints(task.shown, motion, task.start, path.joints[0], free, free_way)
        return replace(path, joints=np.concatenate([joints, path.joints]))
    start_error = float(np.abs(path.joints[0] - task.start).max())
    if not start_error <= START_TOLERANCE_RAD:
        return Rejection(
            reason="branch",
            detail="the way back from the grasp does not end in the start pose",
            metrics={"start_error_rad": start_error},
        )
    return path


def stall(task: PlanTask, joints: Array) -> float:
    """Gripper value 0..1 at which the fingers stall on the handle, the arm at joints (J,) as they close."""
    demo = task.shown.demo
    measured = float(np.median(demo.gripper[demo.contact_frames]))
    return stalling_gripper(task.placed, joints, task.fitted.start_theta, measured)


def check_grip(task: PlanTask, motion: RetargetedMotion, contact: Array) -> Rejection | None:
    """What keeps the hand from holding in this grasp, whatever the ways there and back: tier A at the knots (K, J)."""
    thetas, still = motion.thetas(task.shown.knots[2]), np.ones(KNOTS)
    result = check_kinematics(
        task.placed, contact, motion.held_at * still, thetas, still > 0, task.params.kinematic
    )
    if not isinstance(result, Rejection):
        return None
    return replace(result, metrics={**result.metrics, "in_contact": 1.0})


def _check_motion(
    task: PlanTask, motion: HandMotion, joints: Array, held_at: float
) -> dict[str, float] | Rejection:
    """Tier A of a whole motion, the fingers as wide open as the handle will hold them."""
    holding = (motion.phases == CONTACT) & (motion.gripper > 0.95)
    # While the fingers close or open about the handle, how far they are is left to the simulation.
    between = (motion.phases == CONTACT) & ~holding
    gripper = np.minimum(motion.gripper, held_at)
    widest = max(0.5 * held_at, float(gripper.min()))
    gripper = np.where(between, np.minimum(gripper, widest), gripper)
    return check_kinematics(task.placed, joints, gripper, motion.thetas, holding, task.params.kinematic)


def _located(rejection: Rejection, motion: HandMotion, first: int = 0) -> Rejection:
    """A Rejection of rows from `first` on, with where it is: in contact no way there and back can mend it."""
    row = first + round(rejection.metrics["sample"])
    where = {"path_share": row / len(motion.phases), "in_contact": float(motion.phases[row] == CONTACT)}
    return replace(rejection, metrics={**rejection.metrics, **where})
