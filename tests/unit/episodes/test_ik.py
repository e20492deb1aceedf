"""The arm's chain agrees with its model, and paths hold what they promise."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import Rejection, Variation
from aomgen.core.transforms import apply, invert, rotvec_from_matrix
from aomgen.episodes.ik import (
    IkSolver,
    find_arms,
    follow,
    ik_solver,
    path_residuals,
    solve_path,
    solve_smoothly,
)
from aomgen.episodes.joint_limits import IkLimits, check_speed
from aomgen.episodes.planning import PlanParams, plan_episode
from aomgen.robots.loading import load_robot
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import build_scene
from toy_drawer import SUPPORT, fitted_drawer

PHASES = np.ones(80, np.int64)
HINGES = np.zeros(6, bool)


def residuals(robot: RobotModel, Ts_world_ee: np.ndarray, joints: np.ndarray) -> tuple[float, float]:
    """Largest distance of joints to poses by the model's own kinematics, [mm] and [deg]."""
    left = invert(Ts_world_ee) @ robot.ee_poses(joints)
    turns = np.linalg.norm(rotvec_from_matrix(left[:, :3, :3]), axis=1)
    return 1000 * float(np.linalg.norm(left[:, :3, 3], axis=1).max()), float(np.rad2deg(turns.max()))


@pytest.mark.parametrize("kind", ["ur5e", "hinges", "sliding"])
def test_poses_and_jacobians_agree_with_the_model(robot: RobotModel, write_urdf, kind: str) -> None:
    if kind != "ur5e":
        path = write_urdf()
        if kind == "sliding":
            path.write_text(
                path.read_text().replace('"shoulder" type="revolute"', '"shoulder" type="prismatic"')
            )
        robot = load_robot(path)
    solver, rng = ik_solver(robot), np.random.default_rng(0)
    assert robot.slides.any() == (kind == "sliding")
    joints = rng.uniform(*np.clip(robot.joint_limits, -2.0, 2.0).T, (50, len(robot.joint_names)))
    poses, jacobians = solver.kinematics(joints)
    np.testing.assert_allclose(poses, robot.ee_poses(joints), atol=1e-12)
    for j, step in enumerate(1e-6 * np.eye(joints.shape[1])):
        ahead, behind = robot.ee_poses(joints + step), robot.ee_poses(joints - step)
        np.testing.assert_allclose((ahead - behind)[:, :3, 3] / 2e-6, jacobians[:, :3, j], atol=1e-7)
        turns = rotvec_from_matrix(ahead[:, :3, :3] @ behind[:, :3, :3].swapaxes(1, 2)) / 2e-6
        np.testing.assert_allclose(turns, jacobians[:, 3:, j], atol=1e-6)


def test_all_poses_at_once_agree_with_one_after_the_other(
    robot: RobotModel, solver: IkSolver, demo: Demonstration
) -> None:
    """Against a general least-squares solver that starts each pose from the one before."""

    def missed(joints: np.ndarray, T: np.ndarray) -> np.ndarray:
        left = invert(T) @ robot.ee_poses(joints[None])[0]
        return np.concatenate([left[:3, 3], 0.3 * rotvec_from_matrix(left[:3, :3])])

    path = solve_path(solver, demo.Ts_world_ee, demo.joints[0], IkLimits())
    assert isinstance(path, np.ndarray)
    guesses = demo.joints + np.random.default_rng(1).normal(0, 0.02, demo.joints.shape)
    smooth = solve_smoothly(solver, demo.Ts_world_ee, guesses, 10.0, IkLimits())
    assert isinstance(smooth, np.ndarray)
    joints = demo.joints[0]
    for T, there, smoothly in zip(demo.Ts_world_ee, path, smooth, strict=True):
        joints = least_squares(missed, joints, args=(T,), xtol=1e-12).x
        np.testing.assert_allclose(there, joints, atol=0.005)
        np.testing.assert_allclose(smoothly, joints, atol=0.005)


def test_paths_to_random_poses_hold_their_promise(robot: RobotModel, solver: IkSolver) -> None:
    rng, limits, solved = np.random.default_rng(3), IkLimits(), 0
    low, high = np.array([[-2, -2.2, 0.8, -2.2, -2.2, -2], [2, -0.8, 2.3, -0.4, 2.2, 2]])
    for _ in range(60):
        start, end = rng.uniform(low, high, (2, 6))
        # Hand poses of a smooth joint path, some of it near singular poses and limits, with gaps in them.
        shares = np.linspace(0, 1, 60)[:, None]
        asked = robot.ee_poses(start + shares * shares * (3 - 2 * shares) * np.clip(end - start, -1.2, 1.2))
        for path in (
            solve_path(solver, asked, start + rng.normal(0, 0.05, 6), limits),
            solve_smoothly(solver, asked, np.tile(start, (60, 1)), 10.0, limits),
        ):
            if isinstance(path, Rejection):
                continue
            solved += 1
            mm, deg = residuals(robot, asked, path)
            assert mm <= limits.residual_mm + 1e-6
            assert deg <= limits.residual_deg + 1e-6
            worst = [float(values.max()) for values in path_residuals(solver, asked, path)]
            assert worst == pytest.approx([mm, deg], abs=1e-6)
    assert solved > 90


def test_all_configurations_of_a_pose_are_found(robot: RobotModel, solver: IkSolver) -> None:
    """A UR5e reaches a pose in front of it with shoulder left or right, elbow up or down, wrist flipped or not."""
    first = np.array([2.11, -1.51, 2.26, -0.75, 0.53, 1.57])
    T = robot.ee_poses(first[None])[0]
    arms = find_arms(solver, T, first, IkLimits())
    np.testing.assert_array_equal(arms[0], first)
    assert len(arms) >= 8
    mm, deg = residuals(robot, np.repeat(T[None], len(arms), 0), arms)
    assert mm <= IkLimits().residual_mm
    assert deg <= IkLimits().residual_deg
    gaps = np.abs(arms[:, None] - arms).max(-1)
    assert gaps[np.triu_indices(len(arms), 1)].min() > 0.3


def test_plans_of_random_places_hold_their_promise(
    robot: RobotModel, solver: IkSolver, demo: Demonstration
) -> None:
    fitted, limits, rng, planned = fitted_drawer(), IkLimits(), np.random.default_rng(5), 0
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    for index in range(12):
        x, y, yaw = rng.uniform([-0.05, -0.1, -0.6], [0.2, 0.1, 0.6])
        there = Variation(seed=0, index=index, x=x, y=y, yaw=yaw)
        plan = plan_episode(fitted, demo, there, scene, solver, PlanParams())
        if isinstance(plan, Rejection):
            continue
        planned += 1
        np.testing.assert_allclose(plan.Ts_world_ee, robot.ee_poses(plan.joints), atol=1e-9)
        held = apply(plan.T_world_object @ fitted.asset.joint.motion(plan.thetas), fitted.contact_asset[None])
        off = invert(plan.Ts_world_ee) @ np.append(held, np.ones((len(held), 1)), 1)[..., None]
        off = off[plan.phases == 1, :3, 0]
        # The held point stays where it is in the hand.
        assert 1000 * np.linalg.norm(off - off.mean(0), axis=1).max() < 2 * limits.residual_mm
        rates = [np.abs(np.diff(plan.joints, order, axis=0)).max() * plan.fps**order for order in (1, 2, 3)]
        assert np.all(rates <= np.array([limits.speed, limits.acceleration, limits.jerk]) + 1e-9)
    assert planned >= 8


def test_what_is_out_of_reach_is_refused(solver: IkSolver, demo: Demonstration) -> None:
    far = demo.Ts_world_ee.copy()
    far[:, 0, 3] += np.linspace(0, 1.0, len(far))
    for result in (
        solve_path(solver, far, demo.joints[0], IkLimits()),
        solve_smoothly(solver, far, demo.joints, 10.0, IkLimits()),
    ):
        assert isinstance(result, Rejection)
        assert result.reason == "unreachable"
    _, reached = follow(solver, np.stack([demo.Ts_world_ee, far], 1), demo.joints[[0, 0]], IkLimits())
    assert reached[0] == len(far) > reached[1]


def test_joints_stay_within_their_limits(solver: IkSolver, demo: Demonstration) -> None:
    limits = np.array(solver.robot.joint_limits)
    limits[1, 1] = demo.joints[:, 1].max() - 0.1
    narrow = replace(solver, robot=replace(solver.robot, joint_limits=limits))
    for result in (
        solve_path(narrow, demo.Ts_world_ee, demo.joints[0], IkLimits()),
        solve_smoothly(narrow, demo.Ts_world_ee, demo.joints, 10.0, IkLimits()),
    ):
        assert isinstance(result, Rejection)
        assert result.excess == pytest.approx(1 - result.metrics["limit_margin"] / IkLimits().limit_margin)


def test_speed_acceleration_and_jerk_are_those_of_a_sine() -> None:
    """0.2 rad at 0.5 Hz for two periods, eased in: within the limits; faster, or in jumps, not."""
    times = np.arange(80) / 10.0
    ease = np.clip(np.minimum(times, times[::-1]) / 2, 0, 1)
    wave = (ease * ease * (3 - 2 * ease) * 0.2 * np.sin(np.pi * times))[:, None] * np.ones(6)
    figures = check_speed(wave, 10.0, IkLimits(), HINGES, PHASES)
    assert isinstance(figures, dict)
    assert figures["joint_speed"] == pytest.approx(0.2 * np.pi, rel=0.15)
    assert figures["joint_acceleration"] == pytest.approx(0.2 * np.pi**2, rel=0.15)
    fast = check_speed(8 * wave, 10.0, IkLimits(), HINGES, PHASES)
    assert isinstance(fast, Rejection)
    assert fast.reason == "too_fast"
    assert fast.excess == pytest.approx(fast.metrics["joint_speed"] / IkLimits().speed - 1)
    jerky = check_speed(wave + 0.1 * (np.arange(80) >= 40)[:, None], 10.0, IkLimits(), HINGES, PHASES)
    assert isinstance(jerky, Rejection)
    assert jerky.reason == "too_jerky"
    # Slower by the factor that is named, it passes.
    assert jerky.metrics["approach_share"] == jerky.metrics["retreat_share"] == 0
    needed = fast.metrics["contact_share"]
    shares = np.linspace(0, 79, int(1.02 * needed * 80))
    slower = np.interp(shares, np.arange(80), 8 * wave[:, 0])[:, None] * np.ones(6)
    phases = np.ones(len(slower), np.int64)
    assert getattr(check_speed(slower, 10.0, IkLimits(), HINGES, phases), "reason", "") != "too_fast"


def test_a_demonstration_passes_its_own_limits(demo: Demonstration) -> None:
    phases = np.ones(len(demo.joints), np.int64)
    assert isinstance(check_speed(demo.joints, 10.0, IkLimits(), HINGES, phases), dict)
