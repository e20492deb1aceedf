"""Plan one episode: place the object, choose a grasp, retarget, solve the arm, check for collisions.

The arm is solved at the grasp first, then backwards to the start and on to the end: that keeps the demonstration's
branch of the arm where it matters.
"""

from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation
from aomgen.core.transforms import interpolate
from aomgen.core.values import Array
from aomgen.episodes.grasps import Grasp, grasp_depth, grasps
from aomgen.episodes.ik import IkLimits, IkPath, IkSolver, check_speed, solve_path
from aomgen.episodes.retarget import CONTACT, HandMotion, Style, retarget, timing
from aomgen.simulation.collision_check import KinematicLimits, check_kinematics, holding_gripper
from aomgen.simulation.scene import Scene

# The free way to the object: straight in space as the paper has it, or smooth in the joints,
# which no singular pose can spoil.
FreeWay = Literal["cartesian", "joints"]
# The Cartesian way has to end where the demonstration began, on the same branch, [rad].
START_TOLERANCE_RAD = 0.05
# Poses between the demonstrated grasp and the new one: near enough to each other to stay on the branch.
SEED_STEPS = 12
# Reasons of rejection, from early to late.
REASONS = (
    "joint_limit",
    "unreachable",
    "branch",
    "too_fast",
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
        max_slow_down: How much slower than demonstrated a too fast plan may become.
    """

    fps: float = 10.0
    ik: IkLimits = field(default_factory=IkLimits)
    kinematic: KinematicLimits = field(default_factory=KinematicLimits)
    max_slow_down: float = 2.0


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
    placed = scene.placed(T_world_object)
    close = int(np.searchsorted(demo.times_s - demo.times_s[0], timing(demo).start))
    R_front_ee = fitted.T_world_asset[:3, :3].T @ demo.Ts_world_ee[min(close, len(demo.times_s) - 1), :3, :3]
    depth = grasp_depth(fitted.asset, float(demo.grasp_ee[2]), scene.robot)
    best: Rejection | None = None
    tried = 0
    # The contact segment decides most grasps; its Rejection ends a grasp's other ways.
    for grasp in grasps(fitted, R_front_ee, depth, demo.ee_turn_ratio):
        tried += 1
        task = _Task(fitted, demo, variation, T_world_object, placed, solver, params)
        result = _plan_with(task, grasp)
        if isinstance(result, EpisodePlan):
            return result
        if best is None or _rank(result) > _rank(best):
            best = result
    if best is None:
        return Rejection(reason="no_grasp", detail="the asset offers no grasp")
    return Rejection(
        reason=best.reason, detail=best.detail, metrics={**best.metrics, "grasps_tried": float(tried)}
    )


class _Task(NamedTuple):
    """What all grasps of one variation share."""

    fitted: FittedAsset
    demo: Demonstration
    variation: Variation
    T_world_object: Array
    placed: Scene
    solver: IkSolver
    params: PlanParams


class _Ways(NamedTuple):
    """One choice of how to come and go."""

    free: FreeWay
    approach: Style
    retreat: Style


# The demonstrated ways first; the last is the one with the least to go wrong.
WAYS = (
    _Ways("cartesian", "demonstrated", "demonstrated"),
    _Ways("joints", "demonstrated", "demonstrated"),
    _Ways("joints", "straight", "straight"),
)


def _plan_with(task: _Task, grasp: Grasp) -> EpisodePlan | Rejection:
    """The first way of coming and going that works with one grasp."""
    params = task.params
    best: Rejection | None = None
    for ways in WAYS:
        motion, path = _solved(task, grasp, ways)
        result = path if isinstance(path, Rejection) else _collision_free(task, motion, path)
        if isinstance(path, IkPath) and not isinstance(result, Rejection):
            speed = float(np.abs(np.diff(path.joints, axis=0)).max() * params.fps)
            residuals = {"residual_mm": path.residual_mm, "residual_deg": path.residual_deg}
            return EpisodePlan(
                variation=task.variation,
                fitted=task.fitted,
                T_world_object=task.T_world_object,
                fps=params.fps,
                joints=path.joints,
                gripper=motion.gripper,
                thetas=motion.thetas,
                phases=motion.phases,
                Ts_world_ee=task.placed.robot.ee_poses(path.joints),
                grasp=f"{grasp.name}; {ways.free} way, {ways.approach} approach, {ways.retreat} retreat",
                metrics={**result, **residuals, "joint_speed": speed},
            )
        if isinstance(result, Rejection) and (best is None or _rank(result) > _rank(best)):
            best = result
        if isinstance(result, Rejection) and result.metrics.get("in_contact"):
            break
    return best or Rejection(reason="no_grasp")


def _solved(task: _Task, grasp: Grasp, ways: _Ways) -> tuple[HandMotion, IkPath | Rejection]:
    """Hand and arm motion; a motion that is only too fast is tried again more slowly."""
    params, slow_down = task.params, 1.0
    while True:
        motion = retarget(
            task.demo,
            task.fitted,
            task.T_world_object,
            grasp,
            params.fps,
            approach=ways.approach,
            retreat=ways.retreat,
            slow_down=slow_down,
        )
        contact = _solve_contact(task, motion)
        if isinstance(contact, Rejection):
            # No way of coming or going can mend this grasp.
            return motion, replace(contact, metrics={**contact.metrics, "in_contact": 1.0})
        path = _solve_around(task, motion, contact, ways.free)
        if isinstance(path, Rejection):
            return motion, path
        speed = check_speed(path.joints, params.fps, params.ik, task.placed.robot.slides)
        if not isinstance(speed, Rejection):
            return motion, path
        slow_down *= 1.1 * speed.metrics["speed_share"]
        if not slow_down <= params.max_slow_down:
            return motion, speed


def _solve_contact(task: _Task, motion: HandMotion) -> IkPath | Rejection:
    """Arm joints of the contact frames, on the demonstration's branch."""
    demo, contact = task.demo, np.flatnonzero(motion.phases == CONTACT)
    demo_times = demo.times_s - demo.times_s[0]
    nearest = int(np.argmin(np.abs(demo_times - motion.demo_times_s[contact[0]])))
    # Walk from the demonstrated grasp to the new one, so that the branch is the same.
    there = interpolate(
        demo.Ts_world_ee[nearest], motion.Ts_world_ee[contact[0]], np.linspace(0, 1, SEED_STEPS)
    )
    seed = solve_path(task.solver, there, demo.joints[nearest], task.params.ik)
    # Part of that walk may be out of reach although its end is not.
    start = demo.joints[nearest] if isinstance(seed, Rejection) else seed.joints[-1]
    return solve_path(task.solver, motion.Ts_world_ee[contact], start, task.params.ik)


def _solve_around(
    task: _Task, motion: HandMotion, contact_path: IkPath, free_way: FreeWay
) -> IkPath | Rejection:
    """Arm joints of the whole motion, given those of its contact frames.

    Returns:
        The path; or a Rejection "unreachable", "joint_limit" or "branch" (the way back from the
        grasp does not end in the demonstrated start pose).
    """
    contact = np.flatnonzero(motion.phases == CONTACT)
    first, last = contact[0], contact[-1]
    joints = np.empty((len(motion.thetas), contact_path.joints.shape[1]))
    joints[contact] = contact_path.joints
    # Rows before this one are free.
    free = int(np.searchsorted(motion.blend[:first], 1.0 - 1e-9)) if free_way == "joints" else 0
    paths = [contact_path]
    for rows, start in (
        (np.arange(last + 1, len(joints)), contact_path.joints[-1]),
        (np.arange(first - 1, free - 1, -1), contact_path.joints[0]),
    ):
        path = solve_path(task.solver, motion.Ts_world_ee[rows], start, task.params.ik)
        if isinstance(path, Rejection):
            return path
        joints[rows] = path.joints
        paths.append(path)
    start_error = float(np.abs(joints[0] - task.demo.joints[0]).max())
    if free_way == "joints":
        joints[:free] = _free_joints(motion, task.demo, joints[free], free)
    elif not start_error <= START_TOLERANCE_RAD:
        return Rejection(
            reason="branch",
            detail="the way back from the grasp does not end in the demonstrated start pose",
            metrics={"start_error_rad": start_error},
        )
    return IkPath(
        joints=joints,
        residual_mm=max(path.residual_mm for path in paths),
        residual_deg=max(path.residual_deg for path in paths),
    )


def _free_joints(motion: HandMotion, demo: Demonstration, goal: Array, free: int) -> Array:
    """The demonstrated joints, bent so that they end in `goal`: joints (free, J)."""
    times = demo.times_s - demo.times_s[0]
    at = motion.demo_times_s[: free + 1]
    demonstrated = np.stack([np.interp(at, times, column) for column in demo.joints.T], -1)
    return demonstrated[:free] + motion.blend[:free, None] * (goal - demonstrated[free])


def _collision_free(task: _Task, motion: HandMotion, path: IkPath) -> dict[str, float] | Rejection:
    """Tier A with the fingers as wide open as the handle will hold them."""
    fitted, demo, placed = task.fitted, task.demo, task.placed
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
    return check_kinematics(placed, path.joints, gripper, motion.thetas, holding, task.params.kinematic)


def _rank(rejection: Rejection) -> float:
    """How far planning came, to tell which of several rejections says most."""
    known = REASONS.index(rejection.reason) if rejection.reason in REASONS else len(REASONS)
    return known + rejection.metrics.get("path_share", 0.0)
