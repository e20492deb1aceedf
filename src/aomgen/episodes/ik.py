"""Inverse kinematics along paths, all poses of a path at once.

A coarse chain of knots is solved first, each from the previous one, so that the arm keeps its branch; the
poses in between start from the joints of their knots.
Source: damped Gauss-Newton steps (Wampler, 1986) on the product of exponentials of the arm (Brockett, 1984).
"""

from dataclasses import dataclass
from typing import Annotated

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solveh_banded

from aomgen.core.plan import Rejection
from aomgen.core.transforms import cross, interpolate, path_steps, skew, transform
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.episodes.joint_limits import IkLimits, check_margins, list_margins
from aomgen.robots.robot import RobotModel

# Damping of the least-squares step, [m^2]; carries the arm across singular poses instead of around them.
DAMPING = 1e-3
# A rotation by one radian counts as this distance, [m].
TURN_WEIGHT_M = 0.3
# Distance between knots of a chain, path and rotation together, [m]: so small that the step keeps the branch.
KNOT_WAY_M = 0.08
# Largest change of a joint in one step, [rad] or [m]; far targets make long steps, and more would leave the branch.
MAX_STEP = 0.5
# Weight of joint accelerations against end effector errors in a smooth path, [m^2 s^4/rad^2]: 5 rad/s^2
# during a frame of 0.1 s count as much as 1 mm.
SMOOTHNESS = 3e-8
# Regularization of its least-squares step, [m^2]: only keeps it solvable.
STIFFNESS = 1e-6
# A smooth path has converged below this step, [rad]; number of updates of the
# weights; share of a limit to aim at.
SETTLED, ROUNDS, RESERVE = 1e-3, 5, 0.95
# Number of poses between the demonstrated grasp and the new one: near enough to each other
# to stay on the branch.
SEED_STEPS = 12
# Gauss-Newton steps at each of them; the remaining error is reduced at the next.
SEED_ITERATIONS = 4
# Starts from which other configurations of a pose are searched, and steps of each: a UR5e has eight,
# and a few more where its wrist may rotate twice. Configurations that differ by less in each joint
# count as one, [rad] or [m].
ARM_SEEDS, ARM_ITERATIONS, SAME_ARM = 64, 60, 0.3
# Exact solutions are not required: near a singular pose the last 0.2 mm cost a rotation of
# the wrist. [m], [rad].
CLOSE_M, CLOSE_RAD = 2e-4, 2e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class IkSolver:
    """The arm as a chain of J joints, described in the world frame with all joints at zero.

    Attributes:
        robot: Model of the robot.
        lines: Direction and a point of every joint's axis, homogeneous, as columns; [m].
        turning: Coefficients of each joint's transform: `(1, sin q, cos q, q) @ turning`, row by row.
        T_world_home: End effector pose with all joints at zero.
    """

    robot: RobotModel
    lines: Annotated[Array, "J 4 2"]
    turning: Annotated[Array, "J 4 16"]
    T_world_home: Matrix4

    __post_init__ = freeze_arrays

    def kinematics(self, joints: Array) -> tuple[Array, Array]:
        """Compute end effector poses (N, 4, 4) and Jacobians (N, 6, J; linear, angular) at joints (N, J)."""
        q = joints.T
        factors = np.stack([np.ones_like(q), np.sin(q), np.cos(q), q], -1)
        steps = (factors @ self.turning).reshape(*q.shape, 4, 4)
        before = np.empty_like(steps)
        T = np.broadcast_to(np.eye(4), steps.shape[1:])
        for j, step in enumerate(steps):
            before[j] = T
            T = T @ step
        T = T @ self.T_world_home
        directions = (before.reshape(len(q), -1, 4) @ self.lines).reshape(*q.shape, 4, 2)
        axes, slides = directions[..., :3, 0], self.robot.slides
        jacobians = np.empty((*q.shape, 6))
        jacobians[..., :3] = cross(axes, T[:, :3, 3] - directions[..., :3, 1])
        jacobians[..., 3:] = axes
        jacobians[slides, :, :3], jacobians[slides, :, 3:] = axes[slides], 0.0
        return T, np.ascontiguousarray(jacobians.transpose(1, 2, 0))

    def errors(self, Ts_world_ee: Array, joints: Array) -> tuple[Array, Array]:
        """Compute errors (N, 6) against poses (N, 4, 4), [m] and [rad], and Jacobians (N, 6, J)."""
        T, jacobians = self.kinematics(joints)
        turn = Ts_world_ee[:, :3, :3] @ T[:, :3, :3].swapaxes(1, 2)
        sines = 0.5 * (turn[:, [2, 0, 1], [1, 2, 0]] - turn[:, [1, 2, 0], [2, 0, 1]])
        sine = np.sqrt((sines**2).sum(1))
        angle = np.arctan2(sine, 0.5 * (turn[:, 0, 0] + turn[:, 1, 1] + turn[:, 2, 2] - 1))
        errors = np.empty((len(joints), 6))
        errors[:, :3] = Ts_world_ee[:, :3, 3] - T[:, :3, 3]
        errors[:, 3:] = sines * (angle / np.maximum(sine, 1e-12))[:, None]
        return errors, jacobians


def ik_solver(robot: RobotModel) -> IkSolver:
    """Read the arm's chain from its model."""
    model = robot.spec(visual=False).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = robot.qpos(np.zeros((1, len(robot.joint_names))), 0.0)[0]
    mujoco.mj_kinematics(model, data)
    ids = [model.joint(name).id for name in robot.joint_names]
    site, axes, points = data.site(robot.ee_site), data.xaxis[ids], data.xanchor[ids]
    lines, turning = np.zeros((len(ids), 4, 2)), np.zeros((len(ids), 4, 4, 4))
    lines[:, :3, 0], lines[:, :3, 1], lines[:, 3, 1] = axes, points, 1.0
    for j, (axis, point) in enumerate(zip(axes, points, strict=True)):
        if robot.slides[j]:
            turning[j, 0], turning[j, 3, :3, 3] = np.eye(4), axis
            continue
        along, K = np.outer(axis, axis), skew(axis)
        across = np.eye(3) - along
        # Rodrigues' formula for a line through a point.
        turning[j, :3, :3, :3] = along, K, across
        turning[j, :3, :3, 3] = across @ point, -K @ point, -across @ point
        turning[j, 0, 3, 3] = 1.0
    T_world_home = transform(site.xmat.reshape(3, 3), site.xpos)
    return IkSolver(robot=robot, lines=lines, turning=turning.reshape(-1, 4, 16), T_world_home=T_world_home)


def solve_path(
    solver: IkSolver, Ts_world_ee: Array, start_joints: ArrayLike, limits: IkLimits
) -> Array | Rejection:
    """Solve arm joints (T, J) along a path of end effector poses (T, 4, 4) with small steps.

    The configuration before the first pose (J,) determines the branch. Speed is left to `check_speed`, as
    only the caller knows the time.

    Returns:
        The path; or a Rejection "unreachable" or "joint_limit" at the first pose that breaks a limit.

    Not checked: collisions.
    """
    Ts = np.asarray(Ts_world_ee, np.float64)
    way = np.append(0.0, np.cumsum(path_steps(Ts, TURN_WEIGHT_M)))
    marks = np.linspace(0, way[-1], 2 + int(way[-1] / KNOT_WAY_M))
    rows = np.unique(np.searchsorted(way, marks).clip(0, len(way) - 1))
    knots, _ = follow(solver, Ts[rows, None], np.asarray(start_joints)[None], limits)
    guesses = np.stack([np.interp(np.arange(len(Ts)), rows, q) for q in knots[:, 0].T], 1)
    return _judge(solver, Ts, converge(solver, Ts, guesses, limits.iterations), limits)


def solve_smoothly(
    solver: IkSolver,
    Ts_world_ee: Array,
    guesses: Array,
    fps: float,
    limits: IkLimits,
) -> Array | Rejection:
    """Solve a path from joints near the solution (T, J), as smoothly as the residual limits allow.

    Near a singular pose, where exact joints would jump, the end effector
    deviates by up to those limits instead.
    """
    low, high = solver.robot.joint_limits.T
    joints, count = np.clip(guesses, low, high), len(guesses)
    second = np.diff(np.eye(count), 2, axis=0)
    bending = SMOOTHNESS * fps**4 * (second.T @ second)
    weights = np.ones((count, 2))
    for _ in range(ROUNDS):
        for _ in range(limits.iterations):
            errors, J = solver.errors(Ts_world_ee, joints)
            scales = np.repeat(weights * [1.0, TURN_WEIGHT_M], 3, axis=1)[..., None]
            J, errors = scales * J, scales * errors[..., None]
            hessians = J.swapaxes(1, 2) @ J
            gradient = (J.swapaxes(1, 2) @ errors)[..., 0] - bending @ joints
            step = _solve_banded(hessians, bending, gradient)
            step *= min(1.0, MAX_STEP / max(float(np.abs(step).max()), 1e-9))
            joints = np.clip(joints + step, low, high)
            if np.abs(step).max() < SETTLED:
                break
        residuals = np.stack(path_residuals(solver, Ts_world_ee, joints), 1)
        shares = residuals / (RESERVE * np.array([limits.residual_mm, limits.residual_deg]))
        if shares.max() <= 1.0:
            break
        # Poses with too large a deviation get more weight in the next round.
        weights *= np.clip(shares, 1.0, 3.0)
    return _judge(solver, Ts_world_ee, joints, limits)


def _solve_banded(hessians: Array, bending: Array, gradient: Array) -> Array:
    """Solve for a step (T, J) with Hessians (T, J, J) of the poses and second differences in time (T, T)."""
    count, size = gradient.shape
    bands = np.zeros((2 * size + 1, count, size))
    for below in range(size):
        bands[below, :, : size - below] = np.diagonal(hessians, -below, 1, 2)
    bands[0] += STIFFNESS
    for later in range(min(3, count)):
        bands[later * size, : count - later] += np.diagonal(bending, -later)[:, None]
    flat = bands.reshape(2 * size + 1, -1)[:, : count * size]
    return solveh_banded(flat, gradient.ravel(), lower=True, check_finite=False).reshape(count, size)


def _judge(solver: IkSolver, Ts_world_ee: Array, joints: Array, limits: IkLimits) -> Array | Rejection:
    """Check joints (T, J) and return them, or a Rejection at the first pose that breaks a limit."""
    residuals_mm, residuals_deg = path_residuals(solver, Ts_world_ee, joints)
    missed = ~((residuals_mm <= limits.residual_mm) & (residuals_deg <= limits.residual_deg))
    row = int(np.argmax(missed)) if missed.any() else len(joints)
    near_limit = check_margins(solver.robot, joints[:row], list_margins(solver.robot, limits))
    if near_limit is not None:
        return near_limit
    if row == len(joints):
        return joints
    mm, deg = float(residuals_mm[row]), float(residuals_deg[row])
    return Rejection(
        reason="unreachable",
        detail=f"{mm:.1f} mm and {deg:.1f} deg from the requested pose",
        metrics={"residual_mm": mm, "residual_deg": deg, "sample": float(row)},
        excess=max(mm / limits.residual_mm, deg / limits.residual_deg) - 1.0,
    )


def follow(
    solver: IkSolver, Ts_world_ee: Array, starts: Array, limits: IkLimits
) -> tuple[Array, NDArray[np.int64]]:
    """Solve joints (K, B, J) along B chains of poses (K, B, 4, 4), starting at (B, J).

    Returned with them is how many poses of each chain (B,) were reached; a chain stops
    before a pose that it misses.
    """
    joints = np.empty((*Ts_world_ee.shape[:2], starts.shape[1]))
    now, reached = np.array(starts), np.zeros(len(starts), np.int64)
    for k, poses in enumerate(Ts_world_ee):
        live = np.flatnonzero(reached == k)
        found = converge(solver, poses[live], now[live], limits.iterations)
        mm, deg = path_residuals(solver, poses[live], found)
        there = (mm <= limits.residual_mm) & (deg <= limits.residual_deg)
        now[live[there]] = found[there]
        reached[live[there]] += 1
        joints[k] = now
    return joints, reached


def walk(solver: IkSolver, T_world_from: Array, Ts_world_to: Array, start: Array) -> Array:
    """Solve joints (B, J) at poses (B, 4, 4), on the branch of joints (J,) at a nearby pose (4, 4).

    Poses between them may be out of reach although the last one is not.
    """
    steps = interpolate(T_world_from, Ts_world_to, np.linspace(0, 1, SEED_STEPS)[:, None])
    joints = np.repeat(start[None], len(Ts_world_to), 0)
    for poses in steps:
        joints = converge(solver, poses, joints, SEED_ITERATIONS)
    return joints


def find_arms(solver: IkSolver, T_world_ee: Array, first: Array, limits: IkLimits) -> Array:
    """Find configurations (N, J) that reach a pose (4, 4): `first` (J,), then the most similar ones.

    Configurations that differ by whole turns of a joint count as one.
    """
    low, high = solver.robot.joint_limits.T
    seeds = np.random.default_rng(0).uniform(
        np.maximum(low, -np.pi), np.minimum(high, np.pi), (ARM_SEEDS, len(low))
    )
    Ts = np.repeat(T_world_ee[None], ARM_SEEDS, 0)
    found = converge(solver, Ts, seeds, ARM_ITERATIONS)
    mm, deg = path_residuals(solver, Ts, found)
    found = found[(mm <= limits.residual_mm) & (deg <= limits.residual_deg)]
    turns = np.where(solver.robot.slides, 0.0, 2 * np.pi * np.round((first - found) / (2 * np.pi)))
    turned = found + turns
    found = np.where((turned > low) & (turned < high), turned, found)
    arms = [first]
    for joints in found[np.argsort(np.abs(found - first).sum(1), kind="stable")]:
        if all(np.abs(joints - arm).max() > SAME_ARM for arm in arms):
            arms.append(joints)
    return np.stack(arms)


def converge(
    solver: IkSolver,
    Ts_world_ee: Array,
    starts: Array,
    iterations: int,
    close: tuple[float, float] = (CLOSE_M, CLOSE_RAD),
) -> Array:
    """Compute joints (N, J) by Gauss-Newton from `starts` (N, J) to poses (N, 4, 4), within limits."""
    close_m, close_rad = close
    low, high = solver.robot.joint_limits.T
    weights = np.repeat([1.0, TURN_WEIGHT_M], 3)[:, None]
    joints = np.clip(starts, low, high)
    rows = np.arange(len(joints))
    for _ in range(iterations):
        errors, jacobians = solver.errors(Ts_world_ee[rows], joints[rows])
        squares = errors**2
        left = (squares[:, :3].sum(1) >= close_m**2) | (squares[:, 3:].sum(1) >= close_rad**2)
        if not left.any():
            break
        rows, errors, J = rows[left], weights * errors[left, :, None], weights * jacobians[left]
        gradient = J.swapaxes(1, 2) @ errors
        # A joint at its limit that would go beyond it is held.
        q = joints[rows]
        stuck = ((q <= low) & (gradient[..., 0] < 0)) | ((q >= high) & (gradient[..., 0] > 0))
        J = np.where(stuck[:, None], 0.0, J)
        hessian = J.swapaxes(1, 2) @ J + DAMPING * np.eye(J.shape[2])
        step = np.linalg.solve(hessian, J.swapaxes(1, 2) @ errors)[..., 0]
        step *= np.minimum(1.0, MAX_STEP / np.maximum(np.abs(step).max(1, keepdims=True), 1e-9))
        joints[rows] = np.clip(q + step, low, high)
    return joints


def path_residuals(solver: IkSolver, Ts_world_ee: Array, joints: Array) -> tuple[Array, Array]:
    """Compute distances of joints (N, J) to poses (N, 4, 4): (N,), [mm] and [deg]."""
    errors, _ = solver.errors(Ts_world_ee, joints)
    return 1000 * np.linalg.norm(errors[:, :3], axis=1), np.rad2deg(np.linalg.norm(errors[:, 3:], axis=1))
