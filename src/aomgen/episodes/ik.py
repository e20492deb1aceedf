"""Inverse kinematics along a path: each pose starts from the one before, so the arm keeps its branch."""

from dataclasses import dataclass
from typing import Annotated

import mink
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.plan import Rejection
from aomgen.core.transforms import quat_from_matrix
from aomgen.core.values import Array, freeze_arrays
from aomgen.robots.robot import RobotModel

# Of the least-squares step; carries the arm across singular poses instead of around them.
DAMPING = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class IkLimits:
    """What a solved path must keep.

    Attributes:
        residual_mm, residual_deg: Largest distance to the asked pose.
        speed, slide_speed: Largest speed of a turning and of a sliding joint, [rad/s] and [m/s].
        limit_margin, slide_margin: Distance kept from their limits, [rad] and [m].
        iterations: Gauss-Newton steps a pose.
    """

    residual_mm: float = 1.0
    residual_deg: float = 0.5
    speed: float = 2.6
    slide_speed: float = 1.0
    limit_margin: float = 0.02
    slide_margin: float = 0.002
    iterations: int = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class IkPath:
    """A solved path: joints, and its largest residuals."""

    joints: Annotated[Array, "_ _"]
    residual_mm: float
    residual_deg: float

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class IkSolver:
    """The robot and its compiled model without visual meshes, ready for many paths; qpos addresses of the arm joints."""

    robot: RobotModel
    model: mujoco.MjModel
    addresses: NDArray[np.int64]


def ik_solver(robot: RobotModel) -> IkSolver:
    """Compile the robot alone for inverse kinematics."""
    model = robot.spec(visual=False).compile()
    addresses = np.array([model.joint(name).qposadr[0] for name in robot.joint_names], np.int64)
    return IkSolver(robot=robot, model=model, addresses=addresses)


def solve_path(
    solver: IkSolver, Ts_world_ee: Array, start_joints: ArrayLike, limits: IkLimits
) -> IkPath | Rejection:
    """Arm joints along a path of end effector poses (T, 4, 4), close enough together for the arm to follow.

    Where the arm is before the first pose (J,) sets its branch. Speed is left to `check_speed`, as only the caller
    knows the time.

    Returns:
        The path; or a Rejection "unreachable" or "joint_limit" at the first pose that breaks a limit.

    Not checked: collisions.
    """
    configuration = mink.Configuration(solver.model)
    qpos = solver.robot.qpos(np.asarray(start_joints)[None], 0.0)[0]
    configuration.update(qpos)
    task = mink.FrameTask(solver.robot.ee_site, "site", position_cost=1.0, orientation_cost=0.3)
    bounds = [mink.ConfigurationLimit(solver.model)]
    low, high = solver.robot.joint_limits.T
    keep = np.where(solver.robot.slides, limits.slide_margin, limits.limit_margin)
    joints = np.empty((len(Ts_world_ee), len(solver.addresses)))
    worst_mm, worst_deg = 0.0, 0.0
    for row, T in enumerate(np.asarray(Ts_world_ee, np.float64)):
        task.set_target(mink.SE3(np.concatenate([quat_from_matrix(T[:3, :3]), T[:3, 3]])))
        residual_mm, residual_deg = _converge(configuration, task, bounds, limits)
        joints[row] = configuration.q[solver.addresses]
        worst_mm, worst_deg = max(worst_mm, residual_mm), max(worst_deg, residual_deg)
        done = row / max(len(Ts_world_ee) - 1, 1)
        if not (residual_mm <= limits.residual_mm and residual_deg <= limits.residual_deg):
            return Rejection(
                reason="unreachable",
                detail=f"{residual_mm:.1f} mm and {residual_deg:.1f} deg from the asked pose",
                metrics={"residual_mm": residual_mm, "residual_deg": residual_deg, "path_share": done},
            )
        margins = np.minimum(joints[row] - low, high - joints[row])
        worst = int(np.argmin(margins / keep))
        if not margins[worst] >= keep[worst]:
            return Rejection(
                reason="joint_limit",
                detail=f"{solver.robot.joint_names[worst]} is {margins[worst]:.3f} from its limit, at least {keep[worst]} wanted",
                metrics={"limit_margin": float(margins[worst]), "path_share": done},
            )
    return IkPath(joints=joints, residual_mm=worst_mm, residual_deg=worst_deg)


def check_speed(joints: Array, fps: float, limits: IkLimits, slides: NDArray[np.bool_]) -> float | Rejection:
    """Largest speed on a path (T, J) as a share of its joint's limit; or a Rejection "too_fast".

    A jump is one too. `slides` tells which joints (J,) are prismatic.
    """
    limit = np.where(slides, limits.slide_speed, limits.speed)
    speeds = np.abs(np.diff(joints, axis=0)) * fps
    shares = (speeds / limit).max(1)
    share = float(shares.max(initial=0.0))
    if share <= 1.0:
        return share
    step = int(shares.argmax())
    joint = int((speeds[step] / limit).argmax())
    detail = f"joint {joint + 1} moves at {speeds[step, joint]:.1f} per second at {step / fps:.1f} s, limit {limit[joint]}"
    return Rejection(
        reason="too_fast",
        detail=detail,
        metrics={"joint_speed": float(speeds[step, joint]), "speed_share": share},
    )


def _converge(
    configuration: mink.Configuration,
    task: mink.FrameTask,
    bounds: list[mink.ConfigurationLimit],
    limits: IkLimits,
) -> tuple[float, float]:
    """Gauss-Newton steps towards the task; the remaining distance, [mm] and [deg]."""
    for _ in range(limits.iterations):
        error = task.compute_error(configuration)
        # Good enough is better than exact: near a singular pose the last 0.2 mm cost a turn of the wrist.
        if np.linalg.norm(error[:3]) < 2e-4 and np.linalg.norm(error[3:]) < 2e-3:
            break
        velocity = mink.solve_ik(configuration, [task], 1.0, "daqp", damping=DAMPING, limits=bounds)
        # Far targets make long steps; half a radian at once would leave the branch.
        velocity *= min(1.0, 0.5 / max(float(np.abs(velocity).max()), 1e-9))
        configuration.integrate_inplace(velocity, 1.0)
    error = task.compute_error(configuration)
    return 1000 * float(np.linalg.norm(error[:3])), float(np.rad2deg(np.linalg.norm(error[3:])))
