"""Verification passes what opens the object by contact, certifies it, and catches ways to cheat."""

import copy
import json
from dataclasses import fields, replace

import mujoco
import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.boxes import OrientedBox
from aomgen.core.plan import EpisodePlan, Rejection, VerifiedEpisode
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.core.verdict import Setting, SettingOutcome
from aomgen.robots.robot import RobotModel
from aomgen.simulation.collision_check import (
    KinematicLimits,
    check_kinematics,
    holding_gripper,
    stalling_gripper,
)
from aomgen.simulation.episode_scene import table_overlap_m
from aomgen.simulation.judge import PassRule, judge
from aomgen.simulation.replay import SimulatedRun, simulate
from aomgen.simulation.scene import Scene, build_scene
from aomgen.simulation.settings import apply_setting, corner_setting, draw_settings
from aomgen.simulation.touches import Touches
from aomgen.simulation.verify import verify_plan
from aomgen.version import __version__
from toy_plans import LEFT_RIGHT, SUPPORT, drawer_plan, facing_robot, microwave_plan, pulled, toy_plan

TRAVEL = 0.15


@pytest.fixture(scope="module")
def plan(robot: RobotModel) -> EpisodePlan:
    return drawer_plan(robot)


@pytest.fixture(scope="module")
def asset(plan: EpisodePlan) -> ArticulatedAsset:
    return plan.fitted.asset


@pytest.fixture(scope="module")
def nominal(asset: ArticulatedAsset) -> Setting:
    return draw_settings(asset, 0, 0)[-1]


@pytest.fixture(scope="module")
def scene(robot: RobotModel, plan: EpisodePlan) -> Scene:
    return build_scene(robot, plan.fitted.asset, plan.T_world_object, SUPPORT)


@pytest.fixture(scope="module")
def passed(scene: Scene, plan: EpisodePlan) -> VerifiedEpisode:
    result = verify_plan(plan, scene, digests={"demonstration": "d" * 64})
    assert isinstance(result, VerifiedEpisode), result
    return result


@pytest.fixture(scope="module")
def run(scene: Scene, plan: EpisodePlan, nominal: Setting) -> SimulatedRun:
    return run_of(scene, plan, nominal)


def run_of(scene: Scene, plan: EpisodePlan, setting: Setting, **options) -> SimulatedRun:
    run = simulate(scene, plan.joints, plan.gripper, plan.fps, setting=setting, **options)
    assert isinstance(run, SimulatedRun)
    return run


def reason(run: SimulatedRun, plan: EpisodePlan, scene: Scene, setting: Setting) -> str:
    result = judge(run, plan.fitted, scene, setting, PassRule())
    return result.reason if isinstance(result, Rejection) else "passed"


def test_honest_pull_passes_in_all_settings(passed: VerifiedEpisode, plan: EpisodePlan) -> None:
    verdict = passed.verdict
    assert len(verdict.outcomes) == 3
    assert verdict.margin > 0.05
    assert verdict.margins["contact_share"] > 0.15
    assert all(margin > 0 for margin in verdict.margins.values())
    assert len(passed.reached.thetas) == len(plan.thetas)
    assert abs(passed.reached.thetas[-1] - TRAVEL) < 0.01
    assert set(passed.contacts.fingers) == {0, 1}
    assert np.all(passed.contacts.forces > 0)
    # The pads press on the bar from both sides, so the normals of the two fingers oppose.
    normals = passed.contacts.normals_world
    mean = [normals[passed.contacts.fingers == side].mean(0) for side in (0, 1)]
    assert mean[0] @ mean[1] < 0


def test_an_arm_that_runs_into_what_stands_there_is_rejected(robot: RobotModel, plan: EpisodePlan) -> None:
    """The box is where the wrist goes while it pulls, and nowhere near the drawer."""
    wrist = robot.link_poses(plan.joints[-1:], 1.0)[0, robot.body_names.index("wrist_1_link"), :3, 3]
    box = OrientedBox(T_world_box=transform(np.eye(3), wrist - [0.05, 0, 0]), half_extents=np.full(3, 0.04))
    scene = build_scene(robot, plan.fitted.asset, plan.T_world_object, SUPPORT, obstacles=(box,))
    result = verify_plan(plan, scene)
    assert isinstance(result, Rejection)
    assert result.reason == "robot_contact"


def test_the_certificate_holds_all_figures_limits_and_origins(passed: VerifiedEpisode, scene: Scene) -> None:
    plan = passed.plan
    certificate = passed.verdict.as_json()
    again = verify_plan(plan, scene, digests={"demonstration": "d" * 64})
    assert isinstance(again, VerifiedEpisode)
    text = json.dumps(certificate, allow_nan=False)
    assert text == json.dumps(again.verdict.as_json(), allow_nan=False)
    assert json.loads(text)["versions"] == {
        "aomgen": __version__,
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
    }
    assert sorted(certificate["digests"]) == ["actions", "demonstration"]
    assert certificate["kinematic"]["grip_gap_mm"] == {"value": 1.0, "limit": 10.0, "margin": 9.0}
    for row in certificate["dynamic"]:
        assert 0.2 < row["hold"]["first_s"] < 1.0 < 3.5 < row["hold"]["last_s"] < 4.6
        assert row["hold"]["first_theta"] < 0.01 < 0.14 < row["hold"]["last_theta"]
        assert {"damping", "frictionloss", "moving_mass", "grip_friction", "latch", "latch_reach"} <= set(row)
        assert set(certificate["limits"]) <= set(row)
    for name, margin in certificate["margins"].items():
        values, limit = [row[name] for row in certificate["dynamic"]], certificate["limits"][name]
        least = min(values) - limit if name in ("target_share", "contact_share") else limit - max(values)
        assert margin == least


def test_one_changed_action_changes_the_digest(passed: VerifiedEpisode, scene: Scene) -> None:
    joints = passed.plan.joints.copy()
    joints[-1, 5] += 1e-12
    other = verify_plan(replace(passed.plan, joints=joints), scene)
    assert isinstance(other, VerifiedEpisode)
    assert other.verdict.digests["actions"] != passed.verdict.digests["actions"]


def approaching(plan: EpisodePlan, robot: RobotModel) -> EpisodePlan:
    """The same plan after one second in which the hand stands before the handle."""
    asset, T = plan.fitted.asset, plan.T_world_object
    R = plan.Ts_world_ee[0, :3, :3]
    away = toy_plan(robot, asset, T, R, np.zeros(2), offset_ee=(0.0, 0.0, -0.08)).joints[:1]
    shares = np.minimum(np.arange(12) / 10, 1.0)[:, None]
    rows = np.concatenate([away + shares * (plan.joints[:1] - away), plan.joints])
    return replace(
        plan,
        times_s=np.arange(len(rows)) / plan.fps,
        joints=rows,
        gripper=np.concatenate([np.zeros(12), plan.gripper]),
        thetas=np.concatenate([np.zeros(12), plan.thetas]),
        phases=np.ones(len(rows)),
        Ts_world_ee=robot.ee_poses(rows),
    )


@pytest.mark.parametrize("category", ["drawer", "microwave"])
def test_a_run_that_shares_the_approach_is_the_run_from_the_start_bit_for_bit(
    robot: RobotModel, category: str
) -> None:
    plan = approaching({"drawer": drawer_plan, "microwave": microwave_plan}[category](robot), robot)
    asset = plan.fitted.asset
    scene = build_scene(robot, asset, plan.T_world_object, SUPPORT)
    first, *others = draw_settings(asset, 0, 3)
    approach = run_of(scene, plan, first)
    assert 100 < approach.untouched[0] < len(approach.thetas) / 2
    for setting in others:
        whole = run_of(scene, plan, setting)
        shared = run_of(scene, plan, setting, approach=approach)
        for name in ("joints", "gripper", "thetas", "rates", "torques", "Ts_world_ee", "bases_world"):
            assert getattr(shared, name).tobytes() == getattr(whole, name).tobytes(), name
        for item in fields(Touches):
            a, b = getattr(shared.touches, item.name), getattr(whole.touches, item.name)
            assert a.tobytes() == b.tobytes(), item.name


def test_a_lid_that_shares_the_approach_ends_where_it_would_have(robot: RobotModel) -> None:
    asset = make_asset("toolbox", 2)
    T = facing_robot(asset, (0.6, -0.1))
    plan = toy_plan(robot, asset, T, LEFT_RIGHT, pulled(0.0))
    scene = build_scene(robot, asset, T, SUPPORT)
    first, other, _ = draw_settings(asset, 0, 0)
    away = replace(plan, joints=np.tile([0.0, -1.57, 0.0, -1.57, 0.0, 0.0], (46, 1)))
    whole = run_of(scene, away, other)
    shared = run_of(scene, away, other, approach=run_of(scene, away, first))
    assert np.abs(whole.thetas - shared.thetas).max() < 1e-4


def test_eight_episodes_meet_all_corners_and_each_both_levels(asset: ArticulatedAsset) -> None:
    for seed in range(3):
        drawn = [draw_settings(asset, seed, index) for index in range(8, 16)]
        assert drawn == [draw_settings(asset, seed, index) for index in range(8, 16)]
        assert len({setting.name for settings in drawn for setting in settings[:2]}) == 16
        for stiff, easy, last in drawn:
            assert last.name == "nominal"
            assert stiff.frictionloss > easy.frictionloss
            assert {stiff.moving_mass > easy.moving_mass, stiff.latch > 0, easy.latch > 0} >= {True, False}
            assert {stiff.grip_friction, easy.grip_friction} == {0.6, 1.25}
    orders = [[draw_settings(asset, 0, 8 * block + k)[0].name for k in range(8)] for block in range(4)]
    assert len({tuple(order) for order in orders}) > 1, "corners do not repeat with the index"


@pytest.mark.parametrize("category", ["drawer", "cabinet", "microwave", "laptop", "toolbox"])
def test_a_latch_holds_what_hangs_or_slides_and_no_lid(category: str) -> None:
    asset = make_asset(category, 1)
    setting = corner_setting(asset, True, True, True, True)
    lid = category in ("laptop", "toolbox")
    assert (setting.latch == 0) == lid
    if asset.joint.type == "revolute" and not lid:
        lever = setting.latch / 15.0
        assert 0.1 < lever < 0.6
        assert setting.latch_reach * lever == pytest.approx(0.004)


@pytest.mark.parametrize(("pull_n", "opens"), [(11.0, False), (11.9, False), (12.3, True)])
def test_a_latch_holds_until_its_force_is_exceeded(
    robot: RobotModel, plan: EpisodePlan, nominal: Setting, pull_n: float, opens: bool
) -> None:
    """On a slope the drawer's weight pulls, against 2 N of dry friction and 10 N of latch."""
    slope = np.arcsin(pull_n / (9.81 * nominal.moving_mass))
    tilted = plan.T_world_object @ transform(matrix_from_rotvec(np.array([slope, 0.0, 0.0])), np.zeros(3))
    still = replace(plan, joints=np.tile([0.0, -1.57, 0.0, -1.57, 0.0, 0.0], (46, 1)))
    setting = replace(nominal, damping=0.0, latch=10.0, latch_reach=0.004)
    scene = build_scene(robot, plan.fitted.asset, tilted, replace(SUPPORT, height=-1.0))
    run = run_of(scene, still, setting)
    assert len(run.touches.ticks) == 0
    if not opens:
        assert np.abs(run.thetas).max() < 1e-4
        return
    beyond = np.flatnonzero(run.thetas > 0.005)[[0, 20]]
    gained = np.diff(run.rates[beyond])[0] / (20 * run.tick_s)
    assert gained == pytest.approx((pull_n - 2.0) / (nominal.moving_mass + 0.005), rel=0.02)


def test_heavier_parts_follow_with_the_inertia_they_should(scene: Scene, nominal: Setting) -> None:
    """The same push moves a part of four times the mass a quarter as fast."""
    rates = []
    for factor in (1.0, 4.0):
        changed = copy.copy(scene.model)
        setting = replace(nominal, damping=0.0, frictionloss=0.0, moving_mass=factor * nominal.moving_mass)
        apply_setting(scene, changed, setting, 0.05)
        changed.dof_armature[scene.object_dof] = 0.0
        data = mujoco.MjData(changed)
        data.qpos[scene.object_qpos] = 0.05
        data.qfrc_applied[scene.object_dof] = 1.0
        mujoco.mj_step(changed, data, 20)
        rates.append(data.qvel[scene.object_dof])
    assert rates[0] / rates[1] == pytest.approx(4.0, rel=0.01)


def test_object_opened_before_the_hand_came_is_rejected(
    scene: Scene, plan: EpisodePlan, nominal: Setting
) -> None:
    for share in (0.05, 0.5, 1.0):
        run = run_of(scene, plan, nominal, initial_theta=share * TRAVEL)
        assert reason(run, plan, scene, nominal) == "moved_early"


def test_progress_without_contact_is_rejected(
    scene: Scene, run: SimulatedRun, plan: EpisodePlan, nominal: Setting
) -> None:
    assert reason(run, plan, scene, nominal) == "passed"
    log = run.touches
    early = run.thetas[log.ticks] < 0.5 * TRAVEL
    kept = Touches(**{item.name: getattr(log, item.name)[early] for item in fields(Touches)})
    assert reason(replace(run, touches=kept), plan, scene, nominal) == "contact"


def test_not_a_number_never_passes(
    scene: Scene, run: SimulatedRun, plan: EpisodePlan, nominal: Setting
) -> None:
    for name in ("thetas", "rates", "torques", "Ts_world_ee"):
        broken = np.full_like(getattr(run, name), np.nan)
        assert reason(replace(run, **{name: broken}), plan, scene, nominal) != "passed", name


def test_an_object_that_stands_by_friction_tells_when_it_slides(
    robot: RobotModel, asset: ArticulatedAsset, plan: EpisodePlan, nominal: Setting
) -> None:
    light = replace(asset, static=replace(asset.static, mass=0.3), moving=replace(asset.moving, mass=0.2))
    loose = build_scene(robot, light, plan.T_world_object, SUPPORT, bolted=False)
    setting = replace(nominal, frictionloss=20.0, moving_mass=0.2)
    run = run_of(loose, plan, setting)
    outcome = judge(run, plan.fitted, loose, setting, PassRule(target_share=0.0, contact_share=0.0))
    assert isinstance(outcome, Rejection)
    assert outcome.reason == "slides"


def test_the_arm_follows_its_commands_closely(
    scene: Scene, run: SimulatedRun, plan: EpisodePlan, nominal: Setting
) -> None:
    outcome = judge(run, plan.fitted, scene, nominal, PassRule())
    assert isinstance(outcome, SettingOutcome)
    assert outcome.figures["tracking_mm"] < 8
    assert 5 < outcome.peak_force_n < 300


def test_the_drives_carry_the_arm_and_what_it_holds(
    scene: Scene, run: SimulatedRun, plan: EpisodePlan
) -> None:
    """At rest the torques are those of gravity: MuJoCo's own inverse dynamics without gravity compensation."""
    model = copy.copy(scene.model)
    model.body_gravcomp[:] = 0
    data = mujoco.MjData(model)
    data.qpos[:] = scene.qpos(run.joints[:1], run.gripper[:1], 0.0)[0]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(run.torques[0], data.qfrc_bias[scene.arm.dofs], atol=0.5)
    assert np.abs(run.torques[0]).max() > 10


def test_kinematic_check_sees_grip_and_collision(scene: Scene, plan: EpisodePlan) -> None:
    thickness = 2 * plan.fitted.asset.handle_bar.half_extents.min()  # type: ignore[union-attr]
    held = holding_gripper(scene.robot, thickness, 0.7)
    assert 0.5 < held < 0.95
    middle = int(plan.thetas.searchsorted(0.5 * TRAVEL))
    stalled = stalling_gripper(scene, plan.joints[middle], plan.thetas[middle], 0.7)
    assert stalled == pytest.approx(held, abs=0.03)
    wide = stalling_gripper(scene, plan.joints[middle], 0.0, 0.7)
    assert wide > 0.99, "nothing between the fingers"
    gripper, holding = np.full(46, held), np.ones(46, bool)
    limits = KinematicLimits()
    figures = check_kinematics(scene, plan.joints, gripper, plan.thetas, holding, limits)
    assert isinstance(figures, dict), figures
    assert figures["grip_gap_mm"] < 3
    closed = check_kinematics(scene, plan.joints, gripper, np.zeros(46), holding, limits)
    assert isinstance(closed, Rejection)
    inside = scene.place_at(plan.T_world_object @ transform(np.eye(3), np.array([0.0, -0.1, 0.0])))
    struck = check_kinematics(inside, plan.joints, gripper, plan.thetas, ~holding, limits)
    assert isinstance(struck, Rejection)
    assert struck.reason == "collision"
    assert struck.worst is not None
    before, share = divmod(struck.metrics["sample"], 1)
    between = plan.joints[int(before)] + share * np.diff(plan.joints, axis=0)[min(int(before), 44)]
    np.testing.assert_allclose(struck.worst.joints[0], between, atol=1e-9)


def test_a_table_through_the_arm_is_noticed(
    robot: RobotModel, asset: ArticulatedAsset, plan: EpisodePlan
) -> None:
    high = build_scene(robot, asset, plan.T_world_object, replace(SUPPORT, height=0.25))
    assert table_overlap_m(high, plan.joints) > 0.01
    low = build_scene(robot, asset, plan.T_world_object, replace(SUPPORT, height=-0.1))
    assert table_overlap_m(low, plan.joints) == 0
