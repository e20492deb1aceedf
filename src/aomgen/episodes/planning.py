"""Plan one episode: place the object, choose a grasp, retarget, solve the arm, check for collisions.

The arm is solved at the grasp first, then backwards to the start and on to the end: that keeps the demonstration's
branch of the arm where it matters.
"""

from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Literal, NamedTuple, get_args

import numpy as np

from aomgen.core.demonstration import Demonstration
from aomgen.core.episode import PHASES
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation
from aomgen.core.transforms import interpolate
from aomgen.core.values import Array
from aomgen.episodes.grasps import grasps
from aomgen.episodes.ik import (
    IkLimits,
    IkPath,
    IkSolver,
    check_speed,
    converge,
    solve_from,
    solve_paths,
)
from aomgen.episodes.retarget import CONTACT, DemonstratedMotion, HandMotion, RetargetedMotion, Style
from aomgen.simulation.collision_check import KinematicLimits, check_kinematics, holding_gripper
from aomgen.simulation.scene import Scene

# The free way to the object: straight in space as the paper has it, or smooth in the joints,
# which no singular pose can spoil.
FreeWay = Literal["cartesian", "joints"]
# The Cartesian way has to end where the demonstration began, on the same branch, [rad].
START_TOLERANCE_RAD = 0.05
# Poses between the demonstrated grasp and the new one: near enough to each other to stay on the branch.
SEED_STEPS = 12
# Of Gauss-Newton at each of them; what is left over is done at the next.
SEED_ITERATIONS = 4
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


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanParams:
    """How an episode is planned.

    Attributes:
        fps: Samples a second.
        ik: Limits of the arm.
        kinematic: Limits of tier A.
        max_slow_down: How much slower than asked a phase of a too fast plan may become.
        method: "aomgen", or "paper" to compare: the demonstrated contact turned with the object, straight ways beside it.
    """

    fps: float = 10.0
    ik: IkLimits = field(default_factory=IkLimits)
    kinematic: KinematicLimits = field(default_factory=KinematicLimits)
    max_slow_down: float = 2.0
    method: Literal["aomgen", "paper"] = "aomgen"


def plan_episode(
    fitted: FittedAsset,
    demo: Demonstration,
    variation: Variation,
    scene: Scene,
    solver: IkSolver,
    params: PlanParams,
) -> EpisodePlan | Rejection:
    """Plan one episode, with the grasp nearest to the demonstrated one that works.

    Args:
        fitted: The object and its planned motion. It faces as the recorded object did, so its
            axes are those in which the demonstrated hand is understood.
        scene: Robot, table and this asset, at any pose.

    Returns:
        The plan; or the Rejection of the grasp that came farthest, its metrics with the number of
        `grasps_tried`.
    """
    T_world_object = variation.placed(fitted)
    shown = DemonstratedMotion(demo)
    task = _Task(
        shown,
        variation,
        fitted,
        T_world_object,
        scene.placed(T_world_object),
        solver,
        params,
        _start(demo, variation),
    )
    tried = _grasps(task)
    best = Rejection(reason="no_grasp", detail="the asset offers no grasp")
    for motion, contact in zip(tried, _contact_paths(task, tried), strict=True):
        result = contact if isinstance(contact, Rejection) else _plan_with(task, motion, contact)
        if isinstance(result, EpisodePlan):
            return result
        best = max(best, result, key=_rank)
    return replace(best, metrics={**best.metrics, "grasps_tried": float(len(tried))})


class _Task(NamedTuple):
    """What all grasps of one variation share; `start` are the arm's first joints (J,)."""

    shown: DemonstratedMotion
    variation: Variation
    fitted: FittedAsset
    T_world_object: Array
    placed: Scene
    solver: IkSolver
    params: PlanParams
    start: Array


class _Path(NamedTuple):
    """Arm joints (T, J) at moments of the demonstration (T,), [s]."""

    times: Array
    joints: Array


class _Ways(NamedTuple):
    """One choice of how to come and go; `lift` raises the way there and back, [m]."""

    free: FreeWay
    approach: Style
    retreat: Style
    lift: float = 0.0


# The demonstrated ways first; the third is the one with the least to go wrong.
WAYS = (
    _Ways("cartesian", "demonstrated", "demonstrated"),
    _Ways("joints", "demonstrated", "demonstrated"),
    _Ways("joints", "straight", "straight"),
)
# Over what stands in the way, when nothing but a collision beside the handle keeps the ways above.
DETOURS = tuple(_Ways("cartesian", style, style, lift) for lift in (0.12, 0.25) for style in get_args(Style))


def _start(demo: Demonstration, variation: Variation) -> Array:
    return demo.joints[0] + (np.array(variation.start_offset) if variation.start_offset else 0.0)


def _grasps(task: _Task) -> list[RetargetedMotion]:
    """The motions with all grasps that the method tries, the nearest to the demonstrated one first."""
    fitted, demo, shown = task.fitted, task.shown.demo, task.shown
    R_front_ee = fitted.T_world_asset[:3, :3].T @ shown.poses(np.array([shown.moments.start]))[0, :3, :3]
    found = grasps(fitted, R_front_ee, float(demo.grasp_ee[2]), demo.ee_turn_ratio)
    T_world_start = task.placed.robot.ee_poses(task.start[None])[0] if task.variation.start_offset else None
    rigid = task.params.method == "paper"
    return [
        RetargetedMotion(
            shown=shown,
            fitted=fitted,
            T_world_object=task.T_world_object,
            grasp=grasp,
            T_world_start=T_world_start,
            rigid=rigid,
        )
        for grasp in (islice(found, 1) if rigid else found)
    ]


def _contact_paths(task: _Task, motions: list[RetargetedMotion]) -> list[_Path | Rejection]:
    """Arm joints while the hand holds, for all grasps at once, on the demonstration's branch.

    The contact segment decides most grasps: no way of coming or going can mend a Rejection here.
    """
    shown, limits = task.shown, task.params.ik
    close, free = shown.moments.close, shown.moments.free
    times = np.linspace(close, free, max(2, int((free - close) * task.params.fps)))
    targets = [motion.holding(times) for motion in motions]
    # Walk from the demonstrated grasp to the new one, so that the branch is the same; part of that walk may be
    # out of reach although its end is not.
    first = shown.poses(times[:1])[0]
    steps = np.stack([interpolate(first, target[0], np.linspace(0, 1, SEED_STEPS)) for target in targets], 1)
    joints = np.repeat(shown.joints(times[:1]), len(motions), 0)
    for poses in steps:
        joints = converge(task.solver, poses, joints, SEED_ITERATIONS)
    solved = solve_paths(task.solver, targets, joints, limits)
    return [path if isinstance(path, Rejection) else _Path(times, path.joints) for path in solved]


def _plan_with(task: _Task, motion: RetargetedMotion, contact: _Path) -> EpisodePlan | Rejection:
    """The first way of coming and going that works with one grasp."""
    best = _checked_contact(task, motion, contact)
    if best is not None:
        return best
    best = Rejection(reason="no_grasp")
    for ways in WAYS[:1] if motion.rigid else WAYS + DETOURS:
        if ways.lift and best.reason != "collision":
            break
        styled = replace(motion, approach=ways.approach, retreat=ways.retreat, lift=ways.lift)
        result = _planned(task, styled, ways, contact)
        if isinstance(result, EpisodePlan):
            return result
        best = max(best, result, key=_rank)
        if result.metrics.get("in_contact"):
            break
    return best


def _checked_contact(task: _Task, motion: RetargetedMotion, contact: _Path) -> Rejection | None:
    """What keeps the hand from holding with this grasp, whatever the ways there and back."""
    sampled = motion.sample(task.params.fps)
    held = np.flatnonzero(sampled.phases == CONTACT)
    joints = np.stack([np.interp(sampled.demo_times_s[held], contact.times, q) for q in contact.joints.T], 1)
    rows = slice(held[0], held[-1] + 1)
    result = _collision_free(task, sampled, joints, rows)
    return result if isinstance(result, Rejection) else None


def _planned(task: _Task, motion: RetargetedMotion, ways: _Ways, contact: _Path) -> EpisodePlan | Rejection:
    """The episode with one grasp and one way; a motion that is only too fast is tried again more slowly."""
    params, slow_down = task.params, np.ones(len(PHASES))
    known = contact
    while True:
        sampled = motion.sample(params.fps, speed=task.variation.speed, slow_down=slow_down)
        path = _solve(task, sampled, known, ways.free)
        if isinstance(path, Rejection):
            return path
        speed = check_speed(path.joints, params.fps, params.ik, task.placed.robot.slides, sampled.phases)
        if not isinstance(speed, Rejection):
            break
        slow_down *= np.maximum(1.0, 1.05 * np.array([speed.metrics[f"{phase}_share"] for phase in PHASES]))
        if not slow_down.max() <= params.max_slow_down:
            return speed
    result = _collision_free(task, sampled, path.joints, slice(None))
    if isinstance(result, Rejection):
        return result
    return EpisodePlan(
        variation=task.variation,
        fitted=task.fitted,
        T_world_object=task.T_world_object,
        fps=params.fps,
        joints=path.joints,
        gripper=sampled.gripper,
        thetas=sampled.thetas,
        phases=sampled.phases,
        Ts_world_ee=task.placed.robot.ee_poses(path.joints),
        grasp=f"{motion.grasp.name}; {ways.free} way, {ways.approach} approach, {ways.retreat} retreat",
        metrics={**result, "residual_mm": path.residual_mm, "residual_deg": path.residual_deg, **speed},
    )


def _solve(task: _Task, motion: HandMotion, contact: _Path, free_way: FreeWay) -> IkPath | Rejection:
    """Arm joints of the whole motion, given those of its contact segment.

    Returns:
        The path; or a Rejection "unreachable", "joint_limit" or "branch" (the way back from the
        grasp does not end in the start pose).
    """
    limits = task.params.ik
    held = np.flatnonzero(motion.phases == CONTACT)
    guesses = np.stack([np.interp(motion.demo_times_s[held], contact.times, q) for q in contact.joints.T], 1)
    path = solve_from(task.solver, motion.Ts_world_ee[held], guesses, limits)
    if isinstance(path, Rejection):
        return replace(path, metrics={**path.metrics, "in_contact": 1.0})
    first, last = held[0], held[-1]
    # Rows before this one are free.
    free = int(np.searchsorted(motion.blend[:first], 1.0 - 1e-9)) if free_way == "joints" else 0
    around = [np.arange(first - 1, free - 1, -1), np.arange(last + 1, len(motion.thetas))]
    ends = path.joints[[0, -1]]
    kept = [k for k, rows in enumerate(around) if len(rows)]
    paths = solve_paths(task.solver, [motion.Ts_world_ee[around[k]] for k in kept], ends[kept], limits)
    joints = np.empty((len(motion.thetas), path.joints.shape[1]))
    joints[held] = path.joints
    residuals = [(path.residual_mm, path.residual_deg)]
    for k, side in zip(kept, paths, strict=True):
        if isinstance(side, Rejection):
            return side
        joints[around[k]] = side.joints
        residuals.append((side.residual_mm, side.residual_deg))
    if free_way == "joints":
        joints[:free] = _free_joints(task, motion, joints[free], free)
    elif not (start_error := float(np.abs(joints[0] - task.start).max())) <= START_TOLERANCE_RAD:
        return Rejection(
            reason="branch",
            detail="the way back from the grasp does not end in the start pose",
            metrics={"start_error_rad": start_error},
        )
    worst_mm, worst_deg = np.max(residuals, axis=0)
    return IkPath(joints=joints, residual_mm=float(worst_mm), residual_deg=float(worst_deg))


def _free_joints(task: _Task, motion: HandMotion, goal: Array, free: int) -> Array:
    """The demonstrated joints, bent so that they begin at the start and end in `goal`: joints (free, J)."""
    shown = task.shown.joints(motion.demo_times_s[: free + 1])
    blend = motion.blend[:free, None]
    return shown[:free] + (1 - blend) * (task.start - shown[0]) + blend * (goal - shown[free])


def _collision_free(
    task: _Task, motion: HandMotion, joints: Array, rows: slice
) -> dict[str, float] | Rejection:
    """Tier A of joints at `rows` of a motion, the fingers as wide open as the handle will hold them."""
    fitted, demo, placed = task.fitted, task.shown.demo, task.placed
    bar = fitted.asset.handle_bar
    measured = float(np.median(demo.gripper[demo.contact_frames]))
    width = 2 * float(np.min(bar.half_extents)) if bar is not None else 0.0
    held_at = holding_gripper(placed.robot, width, measured) if bar is not None else measured
    holding = (motion.phases == CONTACT) & (motion.gripper > 0.95)
    # While the fingers close or open about the handle, how far they are is left to the simulation.
    between = (motion.phases == CONTACT) & ~holding
    gripper = np.minimum(motion.gripper, held_at)
    widest = max(0.5 * held_at, float(gripper.min()))
    gripper = np.where(between, np.minimum(gripper, widest), gripper)
    result = check_kinematics(
        placed, joints, gripper[rows], motion.thetas[rows], holding[rows], task.params.kinematic
    )
    if isinstance(result, Rejection) and (motion.phases[rows][round(result.metrics["sample"])] == CONTACT):
        return replace(result, metrics={**result.metrics, "in_contact": 1.0})
    return result


def _rank(rejection: Rejection) -> float:
    """How far planning came, to tell which of several rejections says most."""
    known = REASONS.index(rejection.reason) if rejection.reason in REASONS else -1
    return known + rejection.metrics.get("path_share", 0.0)
