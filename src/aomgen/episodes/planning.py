"""Plan one episode: place the object, choose a grasp and a way to it; which grasps would do."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice, product
from typing import Final, NamedTuple

import numpy as np

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation
from aomgen.core.values import Array
from aomgen.episodes.grasp_plan import (
    Method,
    PlanParams,
    PlanTask,
    check_grip,
    follow_contact,
    follow_sides,
    plan_with,
    stall,
)
from aomgen.episodes.grasps import Grasp, between, difference, grasp_depths, grasps
from aomgen.episodes.ik import IkSolver
from aomgen.episodes.retarget import DETOURS, WAYS, DemonstratedMotion, RetargetedMotion, TriedWays
from aomgen.episodes.start import choose_start
from aomgen.robots.robot import RobotModel
from aomgen.simulation.collision_check import self_overlap_mm
from aomgen.simulation.scene import Scene

# Kept free between the object and the arm before its hand, [m]: a lid that resists lags behind its plan.
CLEARANCE_M = 0.003
# To an eighth of the way between two grasps, which are less apart.
HALVINGS: Final = 3
MAX_APART_RAD: Final = np.pi / 2
# Reasons of rejection, from early to late.
REASONS = (
    "joint_limit",
    "unreachable",
    "branch",
    "too_fast",
    "too_jerky",
    "self_collision",
    "collision",
    "grip_collision",
    "no_grip",
)


def plan_episode(
    fitted: FittedAsset,
    demo: Demonstration,
    variation: Variation,
    scene: Scene,
    solver: IkSolver,
    params: PlanParams,
    usual: Grasp | None = None,
) -> EpisodePlan | Rejection:
    """Plan one episode, with the grasp most like the usual one that works, or else like the demonstrated one.

    Args:
        fitted: The object and its planned motion. It faces as the recorded object did, so its
            axes are those in which the demonstrated hand is understood.
        scene: Robot, table and this asset, at any pose.
        usual: See `grasp_choice`.

    Returns:
        The plan; or the Rejection of the grasp that came farthest, its metrics with the number of
        `grasps_tried`.
    """
    task = open_task(fitted, demo, variation, scene, solver, params)
    motions = _motions(task, usual)
    found = _plan(task, motions, WAYS + DETOURS if params.method == "aomgen" else WAYS[:1])
    if isinstance(found, Rejection):
        return found
    return found.plan if usual is None else _nearer(task, motions[0], found).plan


class _Planned(NamedTuple):
    """A plan, and how it came about."""

    plan: EpisodePlan
    motion: RetargetedMotion
    ways: TriedWays


def _plan(
    task: PlanTask, motions: list[RetargetedMotion], all_ways: Sequence[TriedWays]
) -> _Planned | Rejection:
    """The first plan, over ways and then motions; or the rejection that came farthest."""
    held, best = _hold(task, motions)
    # Grasps that hold, and among them those that something blocks beside the handle.
    checked, blocked = set[int](), set[int]()
    for ways in all_ways:
        style, group = ways
        tried = sorted(blocked if ways in DETOURS else held)
        styled = {k: replace(motions[k], **style._asdict()) for k in tried}
        arms = follow_sides(task, styled, held)
        for free, k in product(group, tried):
            if k not in held:
                continue
            result = None if k in checked else check_grip(task, motions[k], held[k])
            checked.add(k)
            if result is None:
                result = plan_with(task, styled[k], arms[k], free)
            if isinstance(result, EpisodePlan):
                return _Planned(result, motions[k], (style, (free,)))
            best = max(best, result, key=_rank)
            if result.metrics.get("in_contact"):
                del held[k]
                blocked.discard(k)
            elif result.reason == "collision":
                blocked.add(k)
    return replace(best, metrics={**best.metrics, "grasps_tried": float(len(motions))})


def _nearer(task: PlanTask, usual: RetargetedMotion, found: _Planned) -> _Planned:
    """A plan whose grasp lies between the usual and the found one, by bisection, as near to the usual one as works.

    Grasps then change with the object's pose by little steps, which policies learn; the grid's are of 15 degrees and more.
    """
    low, high, far = 0.0, 1.0, found.motion
    # Between a hand and one that is turned half round there is none that holds.
    if found.ways in DETOURS or not 0 < difference(usual.grasp, far.grasp) < MAX_APART_RAD:
        return found
    for _ in range(HALVINGS):
        share = (low + high) / 2
        motion = replace(far, grasp=between(usual.grasp, far.grasp, share))
        nearer = _plan(task, [motion], [found.ways])
        if isinstance(nearer, Rejection):
            low = share
        else:
            high, found = share, nearer
    return found


def working_grasps(task: PlanTask) -> list[Grasp]:
    """All grasps with which an episode can be planned the first way, that nearest to the demonstrated first."""
    motions = _motions(task)
    held, _ = _hold(task, motions)
    style, group = WAYS[0]
    styled = {k: replace(motions[k], **style._asdict()) for k in held}
    arms, working = follow_sides(task, styled, held), dict[str, Grasp]()
    for k in held:
        if check_grip(task, motions[k], held[k]) is not None:
            continue
        if any(isinstance(plan_with(task, styled[k], arms[k], free), EpisodePlan) for free in group):
            grasp = motions[k].grasp
            working.setdefault(grasp.name, grasp)
    return list(working.values())


def open_task(
    fitted: FittedAsset,
    demo: Demonstration,
    variation: Variation,
    scene: Scene,
    solver: IkSolver,
    params: PlanParams,
) -> PlanTask:
    """What all grasps of one variation share; arguments as for `plan_episode`."""
    T_world_object = variation.placed(fitted)
    placed = scene.placed(T_world_object, CLEARANCE_M)
    allowed = params.kinematic.max_self_penetration_mm
    allowed += self_overlap_mm(placed, demo.joints[0], float(demo.gripper[0]))
    params = replace(params, kinematic=replace(params.kinematic, max_self_penetration_mm=allowed))
    return PlanTask(
        shown=DemonstratedMotion(demo),
        variation=variation,
        fitted=fitted,
        placed=placed,
        solver=solver,
        params=params,
        start=choose_start(demo, fitted, placed, T_world_object, solver, params.ik, params.kinematic)
        + (np.array(variation.start_offset) if variation.start_offset else 0.0),
    )


def _motions(task: PlanTask, usual: Grasp | None = None) -> list[RetargetedMotion]:
    """Of all grasps, from the arm's first joints."""
    robot, fitted = task.placed.robot, task.fitted
    moved = not np.array_equal(task.start, task.shown.demo.joints[0])
    T_world_start = robot.ee_poses(task.start[None])[0] if moved else None
    T_world_object = task.variation.placed(fitted)
    return retarget(fitted, task.shown, T_world_object, robot, task.params.method, T_world_start, usual)


def _hold(task: PlanTask, motions: list[RetargetedMotion]) -> tuple[dict[int, Array], Rejection]:
    """Joints (K, J) along the contact by number of grasp, where the arm can follow, and what came farthest of the rest.

    These motions learn how far their fingers close.
    """
    contacts = follow_contact(task, motions)
    held = dict[int, Array]()
    best = Rejection(reason="no_grasp", detail="the asset offers no grasp")
    for k, contact in enumerate(contacts):
        if isinstance(contact, Rejection):
            best = max(best, contact, key=_rank)
        else:
            held[k] = contact
            motions[k] = replace(motions[k], held_at=stall(task, contact[0]))
    return held, best


def retarget(
    fitted: FittedAsset,
    shown: DemonstratedMotion,
    T_world_object: Array,
    robot: RobotModel,
    method: Method,
    T_world_start: Array | None = None,
    usual: Grasp | None = None,
) -> list[RetargetedMotion]:
    """The motions with all grasps that a method tries, in the order of `grasps`.

    The hand begins at a pose (4, 4); where it was demonstrated if None.
    """
    demo, rigid = shown.demo, method == "paper"
    depths = grasp_depths(fitted.asset, float(demo.grasp_ee[2]), robot)
    found = grasps(fitted, shown.hand_at_closed(fitted), depths, demo.ee_turn_ratio, usual)
    return [
        RetargetedMotion(
            shown=shown,
            fitted=fitted,
            T_world_object=T_world_object,
            grasp=grasp,
            T_world_start=T_world_start,
            rigid=rigid,
        )
        for grasp in (islice(found, 1) if rigid else found)
    ]


def _rank(rejection: Rejection) -> float:
    """How far planning came, to tell which of several rejections says most."""
    known = REASONS.index(rejection.reason) if rejection.reason in REASONS else -1
    return known + rejection.metrics.get("path_share", 0.0)
