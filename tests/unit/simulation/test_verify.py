"""Verification passes what opens the object by contact, and catches every way to cheat."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.assets.mjcf import RESISTANCES
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.demonstration import SupportPlane
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, SettingOutcome, Variation, VerifiedEpisode
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.episodes.ik import IkLimits, IkPath, ik_solver, solve_path
from aomgen.robots.robot import RobotModel
from aomgen.simulation.collision_check import (
    KinematicLimits,
    check_kinematics,
    holding_gripper,
    table_overlap_m,
)
from aomgen.simulation.replay import SimulatedRun, simulate
from aomgen.simulation.scene import Scene, build_scene
from aomgen.simulation.verify import PassRule, judge, verify_plan

NEAR = np.array([2.11, -1.51, 2.26, -0.75, 0.53, 1.57])
SUPPORT = SupportPlane(height=0.05, low_xy=[-np.inf] * 2, high_xy=[np.inf] * 2)
T_WORLD_OBJECT = transform(matrix_from_rotvec(np.array([0, 0, -np.pi / 2])), np.array([0.92, -0.2, 0.05]))
TRAVEL = 0.15
NOMINAL = RESISTANCES["prismatic"][0]


@pytest.fixture(scope="module")
def asset() -> ArticulatedAsset:
    return make_asset("drawer", 1)


@pytest.fixture(scope="module")
def scene(robot: RobotModel, asset: ArticulatedAsset) -> Scene:
    return build_scene(robot, asset, T_WORLD_OBJECT, SUPPORT)


@pytest.fixture(scope="module")
def plan(robot: RobotModel, asset: ArticulatedAsset) -> EpisodePlan:
    """Close about the drawer's handle, pull 0.15 m, let go."""
    held = apply(T_WORLD_OBJECT, asset.handle_point)
    R = np.stack([np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])], 1)
    u = np.linspace(0, 1, 26)
    pulled = TRAVEL * np.concatenate([np.zeros(10), u * u * (3 - 2 * u), np.ones(10)])
    poses = transform(np.broadcast_to(R, (46, 3, 3)), held - pulled[:, None] * np.array([1.0, 0, 0]))
    path = solve_path(ik_solver(robot), np.concatenate([poses[:1], poses]), NEAR, IkLimits(iterations=60))
    assert isinstance(path, IkPath)
    fitted = FittedAsset(
        asset=asset,
        T_world_asset=T_WORLD_OBJECT,
        contact_asset=asset.handle_point,
        shares=np.linspace(0, 1, 46),
        thetas=pulled,
        scale=1.0,
        mirrored=False,
        mode="trajectory",
        residual_mm=0.0,
    )
    return EpisodePlan(
        variation=Variation(seed=0, index=0, x=0, y=0, yaw=0),
        fitted=fitted,
        T_world_object=T_WORLD_OBJECT,
        fps=10,
        joints=path.joints[1:],
        gripper=np.interp(np.arange(46), [2, 6, 40, 44], [0, 1, 1, 0]),
        thetas=pulled,
        phases=np.ones(46),
        Ts_world_ee=poses,
        grasp="test",
        metrics={},
    )


def run_of(scene: Scene, plan: EpisodePlan, gripper: np.ndarray, initial_theta: float = 0.0) -> SimulatedRun:
    run = simulate(scene, plan.joints, gripper, plan.fps, initial_theta=initial_theta)
    assert isinstance(run, SimulatedRun)
    return run


def reason(run: SimulatedRun, scene: Scene) -> str:
    result = judge(run, TRAVEL, scene, NOMINAL, PassRule())
    return result.reason if isinstance(result, Rejection) else "passed"


def test_honest_pull_passes_in_all_settings(scene: Scene, plan: EpisodePlan) -> None:
    result = verify_plan(plan, scene)
    assert isinstance(result, VerifiedEpisode), result
    assert len(result.verdict.outcomes) == 3
    assert result.verdict.margin > 0.05
    assert all(outcome.contact_share > 0.95 for outcome in result.verdict.outcomes)
    assert all(outcome.tracking_mm < 8 for outcome in result.verdict.outcomes)
    assert len(result.thetas) == len(plan.thetas)
    assert abs(result.thetas[-1] - TRAVEL) < 0.01
    assert set(result.contacts.fingers) == {0, 1}
    assert np.all(result.contacts.forces > 0)
    # The pads press on the bar from both sides, so the normals of the two fingers oppose.
    mean = [result.contacts.normals_world[result.contacts.fingers == side].mean(0) for side in (0, 1)]
    assert mean[0] @ mean[1] < 0


def test_open_gripper_that_never_pulls_is_rejected(scene: Scene, plan: EpisodePlan) -> None:
    assert reason(run_of(scene, plan, np.zeros(46)), scene) == "target"


def test_hand_beside_the_handle_is_rejected(scene: Scene, plan: EpisodePlan) -> None:
    aside = T_WORLD_OBJECT.copy()
    aside[2, 3] -= 0.2
    result = verify_plan(replace(plan, T_world_object=aside), scene)
    assert isinstance(result, Rejection)
    assert result.reason == "target"


def test_object_opened_before_the_hand_came_is_rejected(scene: Scene, plan: EpisodePlan) -> None:
    run = run_of(scene, plan, np.zeros(46), initial_theta=TRAVEL)
    assert run.thetas[-1] > 0.9 * TRAVEL
    assert reason(run, scene) == "pre_opened"


def test_progress_without_contact_is_rejected(scene: Scene, plan: EpisodePlan) -> None:
    run = run_of(scene, plan, plan.gripper)
    assert reason(run, scene) == "passed"
    half = run.pad_forces * (run.thetas < 0.5 * TRAVEL)
    assert reason(replace(run, pad_forces=half), scene) == "contact"


def test_not_a_number_never_passes(scene: Scene, plan: EpisodePlan) -> None:
    run = run_of(scene, plan, plan.gripper)
    assert reason(replace(run, thetas=np.full_like(run.thetas, np.nan)), scene) != "passed"


def test_a_small_target_is_rejected_before_simulation(scene: Scene, plan: EpisodePlan) -> None:
    small = replace(plan, fitted=replace(plan.fitted, thetas=plan.fitted.thetas / 3))
    result = verify_plan(small, scene)
    assert isinstance(result, Rejection)
    assert result.reason == "target_too_small"


def test_an_object_that_stands_by_friction_tells_when_it_slides(
    robot: RobotModel, asset: ArticulatedAsset, plan: EpisodePlan
) -> None:
    light = replace(asset, static=replace(asset.static, mass=0.3), moving=replace(asset.moving, mass=0.2))
    loose = build_scene(robot, light, T_WORLD_OBJECT, SUPPORT, bolted=False, frictionloss=20.0)
    run = simulate(loose, plan.joints, plan.gripper, plan.fps)
    assert isinstance(run, SimulatedRun)
    outcome = judge(run, TRAVEL, loose, NOMINAL, PassRule(target_share=0.0, contact_share=0.0))
    assert isinstance(outcome, Rejection)
    assert outcome.reason == "slides"


def test_the_arm_follows_its_commands_closely(scene: Scene, plan: EpisodePlan) -> None:
    outcome = judge(run_of(scene, plan, plan.gripper), TRAVEL, scene, NOMINAL, PassRule())
    assert isinstance(outcome, SettingOutcome)
    assert outcome.tracking_mm < 8
    assert 5 < outcome.peak_force_n < 300


def test_kinematic_check_sees_grip_and_collision(scene: Scene, plan: EpisodePlan) -> None:
    thickness = 2 * plan.fitted.asset.handle_bar.half_extents.min()  # type: ignore[union-attr]
    held = holding_gripper(scene.robot, thickness, 0.7)
    assert 0.5 < held < 0.95
    gripper, holding = np.full(46, held), np.ones(46, bool)
    limits = KinematicLimits()
    figures = check_kinematics(scene, plan.joints, gripper, plan.thetas, holding, limits)
    assert isinstance(figures, dict), figures
    assert figures["grip_gap_mm"] < 3
    closed = check_kinematics(scene, plan.joints, gripper, np.zeros(46), holding, limits)
    assert isinstance(closed, Rejection)
    inside = scene.placed(T_WORLD_OBJECT @ transform(np.eye(3), np.array([0.0, -0.1, 0.0])))
    struck = check_kinematics(inside, plan.joints, gripper, plan.thetas, ~holding, limits)
    assert isinstance(struck, Rejection)
    assert struck.reason == "collision"


def test_a_table_through_the_arm_is_noticed(
    robot: RobotModel, asset: ArticulatedAsset, plan: EpisodePlan
) -> None:
    high = build_scene(robot, asset, T_WORLD_OBJECT, replace(SUPPORT, height=0.25))
    assert table_overlap_m(high, plan.joints) > 0.01
    assert (
        table_overlap_m(build_scene(robot, asset, T_WORLD_OBJECT, replace(SUPPORT, height=-0.1)), plan.joints)
        == 0
    )
