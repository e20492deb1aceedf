"""Plan one episode: place the object, choose a grasp, retarget, solve the arm, check for collisions."""

from dataclasses import dataclass, field

import numpy as np

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import EpisodePlan, FittedAsset, Variation
from aomgen.core.values import Array
from aomgen.core.verdict import Rejection
from aomgen.generalization.grasps import PINCH, Grasp, HandConventions, grasps
from aomgen.generalization.ik import IkLimits, IkPath, IkSolver, solve_path
from aomgen.generalization.retarget import CONTACT, HandMotion, retarget, timing
from aomgen.physics.kinematic import KinematicLimits, check_kinematics, holding_gripper
from aomgen.physics.scene import Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanParams:
    """How an episode is planned.

    Attributes:
        fps: Samples a second.
        hand: Directions of the gripper.
        ik: Limits of the arm.
        kinematic: Limits of tier A.
        max_slow_down: How much slower than demonstrated a too fast plan may become.
        max_grasps: Grasps tried before a variation is given up.
    """

    fps: float = 10.0
    hand: HandConventions = PINCH
    ik: IkLimits = field(default_factory=IkLimits)
    kinematic: KinematicLimits = field(default_factory=KinematicLimits)
    max_slow_down: float = 2.0
    max_grasps: int = 12


def plan_episode(
    fitted: FittedAsset,
    demo: Demonstration,
    R_world_front: Array,
    variation: Variation,
    scene: Scene,
    solver: IkSolver,
    params: PlanParams,
) -> EpisodePlan | Rejection:
    """Plan one episode, with the grasp nearest to the demonstrated one that works.

    Args:
        fitted: The object and its planned motion.
        demo: The demonstration.
        R_world_front: Upright front frame of the recorded object (3, 3), in which the
            demonstrated hand is understood.
        variation: Where the object stands.
        scene: Robot, table and this asset, at any pose.
        solver: Of the same robot.
        params: See `PlanParams`.

    Returns:
        The plan; or the Rejection of the grasp that came farthest, its metrics with the number of
        `grasps_tried`.
    """
    T_world_object = variation.placed(fitted)
    placed = scene.placed(T_world_object)
    close = int(np.searchsorted(demo.times_s - demo.times_s[0], timing(demo).start))
    R_front_ee = R_world_front.T @ demo.Ts_world_ee[min(close, len(demo.times_s) - 1), :3, :3]
    depth = float(demo.grasp_ee @ params.hand.approach)
    best: Rejection | None = None
    choices = grasps(fitted, R_front_ee, depth, demo.ee_turn_ratio, params.hand)
    for tried, grasp in enumerate(choices, start=1):
        result = _plan_with(fitted, demo, variation, T_world_object, grasp, placed, solver, params)
        if isinstance(result, EpisodePlan):
            return result
        if best is None or _progress(result) > _progress(best):
            best = result
        if tried >= params.max_grasps:
            break
    if best is None:
        return Rejection(reason="no_grasp", detail="the asset offers no grasp")
    return Rejection(
        reason=best.reason, detail=best.detail, metrics={**best.metrics, "grasps_tried": float(tried)}
    )


def _plan_with(
    fitted: FittedAsset,
    demo: Demonstration,
    variation: Variation,
    T_world_object: Array,
    grasp: Grasp,
    placed: Scene,
    solver: IkSolver,
    params: PlanParams,
) -> EpisodePlan | Rejection:
    motion, path = _solved(fitted, demo, T_world_object, grasp, solver, params)
    if isinstance(path, Rejection):
        return path
    figures = _collision_free(fitted, demo, motion, path, placed, params)
    if isinstance(figures, Rejection):
        return figures
    metrics = {
        **figures,
        "residual_mm": path.residual_mm,
        "residual_deg": path.residual_deg,
        "joint_speed": path.speed,
    }
    return EpisodePlan(
        variation=variation,
        fitted=fitted,
        T_world_object=T_world_object,
        fps=params.fps,
        joints=path.joints,
        gripper=motion.gripper,
        thetas=motion.thetas,
        phases=motion.phases,
        Ts_world_ee=motion.Ts_world_ee,
        grasp=grasp.name,
        metrics=metrics,
    )


def _solved(
    fitted: FittedAsset,
    demo: Demonstration,
    T_world_object: Array,
    grasp: Grasp,
    solver: IkSolver,
    params: PlanParams,
) -> tuple[HandMotion, IkPath | Rejection]:
    """Hand and arm motion; a motion that is only too fast is tried again more slowly."""
    slow_down = 1.0
    while True:
        motion = retarget(demo, fitted, T_world_object, grasp, params.hand, params.fps, slow_down)
        path = solve_path(solver, motion.Ts_world_ee, demo.joints[0], params.fps, params.ik)
        if not isinstance(path, Rejection) or path.reason != "too_fast":
            return motion, path
        slow_down *= 1.1 * path.metrics["joint_speed"] / params.ik.speed
        if not slow_down <= params.max_slow_down:
            return motion, path


def _collision_free(
    fitted: FittedAsset,
    demo: Demonstration,
    motion: HandMotion,
    path: IkPath,
    placed: Scene,
    params: PlanParams,
) -> dict[str, float] | Rejection:
    """Tier A with the fingers as wide open as the handle will hold them."""
    bar = fitted.asset.handle_bar
    measured = float(np.median(demo.gripper[demo.contact_frames]))
    width = 2 * float(np.min(bar.half_extents)) if bar is not None else 0.0
    held_at = holding_gripper(placed.robot, width, measured) if bar is not None else measured
    holding = (motion.phases == CONTACT) & (motion.gripper > 0.95)
    # While the fingers close or open about the handle, how far they are is left to the simulation.
    between = (motion.phases == CONTACT) & ~holding
    gripper = np.minimum(motion.gripper, held_at)
    gripper = np.where(between, np.minimum(gripper, 0.5 * held_at), gripper)
    return check_kinematics(placed, path.joints, gripper, motion.thetas, holding, params.kinematic)


def _progress(rejection: Rejection) -> float:
    """How far planning came, to tell which of several rejections says most."""
    order = (
        "unreachable",
        "joint_limit",
        "too_fast",
        "self_collision",
        "collision",
        "grip_collision",
        "no_grip",
    )
    rank = order.index(rejection.reason) if rejection.reason in order else len(order)
    return rank + 0.01 * rejection.metrics.get("time_s", 0.0)
