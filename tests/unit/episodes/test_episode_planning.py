"""Plans follow the object, keep the arm's limits, and say no where they must."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.demonstration import Demonstration, SupportPlane
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation
from aomgen.core.transforms import apply, invert, matrix_from_rotvec
from aomgen.errors import NotEnoughEpisodesError
from aomgen.episodes.planning import PlanParams, plan_episode
from aomgen.episodes.generate import (
    GenerationParams,
    PoseRanges,
    generate_episodes,
    in_view,
    variations,
    worth_trying,
)
from aomgen.episodes.grasps import Grasp, grasps, orientations
from aomgen.episodes.ik import IkLimits, IkPath, IkSolver, check_speed, ik_solver, solve_path
from aomgen.episodes.retarget import CONTACT, gripper_command, retarget, timing
from aomgen.episodes.plans_stage import generate_in, load_generalization
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import build_scene
from toy_drawer import SUPPORT, fitted_drawer, opening


@pytest.fixture(scope="module")
def solver(robot: RobotModel) -> IkSolver:
    return ik_solver(robot)


@pytest.fixture(scope="module")
def fitted() -> FittedAsset:
    return fitted_drawer()


@pytest.fixture(scope="module")
def demo(robot: RobotModel, solver: IkSolver, fitted: FittedAsset) -> Demonstration:
    return opening(solver, fitted)


def grasp_of(demo: Demonstration, fitted: FittedAsset) -> Grasp:
    R = fitted.T_world_asset[:3, :3].T @ demo.Ts_world_ee[demo.contact_frames[0], :3, :3]
    return next(iter(grasps(fitted, R, 0.0, demo.ee_turn_ratio)))


def test_variations_depend_on_seed_and_index_and_stay_in_range() -> None:
    ranges = PoseRanges()
    first, again = (list(islice(variations(3, ranges), 40)) for _ in range(2))
    assert first == again
    assert first[5].index == 5
    assert first != list(islice(variations(4, ranges), 40))
    xs = np.array([[v.x, v.y, np.rad2deg(v.yaw)] for v in first])
    assert np.all(xs.min(0) >= [-0.05, -0.05, -45])
    assert np.all(xs.max(0) <= [0.30, 0.05, 45])
    counts = np.histogram(xs[:, 0], bins=4, range=(-0.05, 0.30))[0]
    assert counts.min() >= 8


def test_ik_meets_the_asked_poses(robot: RobotModel, solver: IkSolver, demo: Demonstration) -> None:
    path = solve_path(solver, demo.Ts_world_ee, demo.joints[0], IkLimits())
    assert isinstance(path, IkPath)
    reached = robot.ee_poses(path.joints)
    errors = invert(demo.Ts_world_ee) @ reached
    assert 1000 * np.linalg.norm(errors[:, :3, 3], axis=1).max() < 0.3
    assert isinstance(check_speed(path.joints, 10.0, IkLimits(), np.zeros(6, bool)), float)


def test_ik_refuses_what_is_out_of_reach_and_jumps(solver: IkSolver, demo: Demonstration) -> None:
    far = demo.Ts_world_ee.copy()
    far[:, 0, 3] += np.linspace(0, 1.0, len(far))
    result = solve_path(solver, far, demo.joints[0], IkLimits())
    assert isinstance(result, Rejection)
    assert result.reason == "unreachable"
    jump = demo.joints.copy()
    jump[20:] += 1.0
    assert isinstance(check_speed(jump, 10.0, IkLimits(), np.zeros(6, bool)), Rejection)


def test_fingers_close_across_the_handle_and_the_nearest_way_comes_first() -> None:
    R = matrix_from_rotvec(np.array([0.1, -0.2, 0.3]))
    for axis in np.eye(3):
        named = list(orientations(R, axis, (0.0, 20.0)))
        for _, R_hand in named:
            assert abs(R_hand[:, 1] @ axis) < 1e-9
        options = [R_hand for name, R_hand in named if "swing" not in name]
        turns = [np.arccos(np.clip((np.trace(R.T @ Q) - 1) / 2, -1, 1)) for Q in options]
        assert int(np.argmin(turns)) in (0, 1)
        assert turns[0] <= np.pi / 2 + 1e-9


def test_gripper_command_closes_fully_around_a_bar(demo: Demonstration) -> None:
    command = gripper_command(demo)
    assert command[0] == 0
    assert np.all(command[demo.contact_frames] == 1)
    moments = timing(demo)
    assert moments.close == pytest.approx(2.6, abs=0.11)
    assert moments.free == pytest.approx(6.5, abs=0.16)


def test_same_object_at_the_same_place_gives_the_demonstrated_motion(
    demo: Demonstration, fitted: FittedAsset
) -> None:
    motion = retarget(demo, fitted, fitted.T_world_asset, grasp_of(demo, fitted), 10.0)
    assert len(motion.thetas) == len(demo.times_s)
    assert 1000 * np.abs(motion.Ts_world_ee[:, :3, 3] - demo.Ts_world_ee[:, :3, 3]).max() < 12
    np.testing.assert_allclose(motion.Ts_world_ee[:, :3, :3], demo.Ts_world_ee[:, :3, :3], atol=1e-3)


def test_contact_segment_moves_rigidly_with_the_object(demo: Demonstration, fitted: FittedAsset) -> None:
    variation = Variation(seed=0, index=0, x=0.04, y=-0.03, yaw=0.3)
    T = variation.placed(fitted)
    grasp = grasp_of(demo, fitted)
    there = retarget(demo, fitted, T, grasp, 10.0)
    here = retarget(demo, fitted, fitted.T_world_asset, grasp, 10.0)
    moved = T @ invert(fitted.T_world_asset) @ here.Ts_world_ee[here.phases == CONTACT]
    times = here.demo_times_s[here.phases == CONTACT]
    same = np.abs(there.demo_times_s[:, None] - times[None]).min(1) < 1e-9
    rows = np.flatnonzero(same & (there.phases == CONTACT))
    match = [int(np.argmin(np.abs(times - there.demo_times_s[row]))) for row in rows]
    if len(rows):
        np.testing.assert_allclose(there.Ts_world_ee[rows], moved[match], atol=1e-9)
    held = apply(there.Ts_world_ee, grasp.held_ee[None])
    handle = apply(T @ fitted.asset.joint.motion(there.thetas), fitted.contact_asset[None])
    contact = there.phases == CONTACT
    np.testing.assert_allclose(held[contact], handle[contact], atol=1e-9)
    np.testing.assert_allclose(there.Ts_world_ee[0], demo.Ts_world_ee[0], atol=1e-6)


def test_plan_starts_where_the_demonstration_did_and_is_smooth(
    robot: RobotModel, solver: IkSolver, demo: Demonstration, fitted: FittedAsset
) -> None:
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    plan = plan_episode(
        fitted, demo, Variation(seed=0, index=0, x=0.03, y=0.02, yaw=0.2), scene, solver, PlanParams()
    )
    assert isinstance(plan, EpisodePlan), plan
    assert np.abs(plan.joints[0] - demo.joints[0]).max() < 0.05
    assert plan.metrics["residual_mm"] < 1.0
    assert plan.metrics["penetration_mm"] <= 1.0
    assert plan.metrics["joint_speed"] <= PlanParams().ik.speed
    assert plan.thetas[-1] == pytest.approx(fitted.target_theta)


def test_pose_out_of_reach_is_rejected_with_a_reason(
    robot: RobotModel, solver: IkSolver, demo: Demonstration, fitted: FittedAsset
) -> None:
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    far = Variation(seed=0, index=0, x=0.8, y=0.0, yaw=0.0)
    result = plan_episode(fitted, demo, far, scene, solver, PlanParams())
    assert isinstance(result, Rejection)
    assert result.reason == "unreachable"
    assert result.metrics["grasps_tried"] >= 7


def test_generation_is_reproducible_and_survives_its_folder(
    robot: RobotModel, demo: Demonstration, fitted: FittedAsset, tmp_path
) -> None:
    params = GenerationParams(count=2, seed=5, ranges=PoseRanges(x_m=(-0.02, 0.05), yaw_deg=(-15, 15)))
    made = generate_in(tmp_path, [fitted], demo, robot, SUPPORT, params, lambda share, text: None)
    assert len(made.episodes) == 2
    loaded = load_generalization(tmp_path, [fitted])
    for a, b in zip(made.episodes, loaded, strict=True):
        np.testing.assert_array_equal(a.joints, b.joints)
        np.testing.assert_array_equal(a.contacts.forces, b.contacts.forces)
        assert a.verdict.as_json() == b.verdict.as_json()
        assert a.verdict.margin >= 0
        assert len(a.contacts.frames) > 10


def test_too_few_episodes_stop_with_counted_reasons(
    robot: RobotModel, demo: Demonstration, fitted: FittedAsset
) -> None:
    # A travel below the minimum can never pass.
    short = replace(fitted, thetas=fitted.thetas / 3)
    params = GenerationParams(
        count=1, ranges=PoseRanges(x_m=(0, 0.01), yaw_deg=(-2, 2)), attempts_per_episode=2
    )
    with pytest.raises(NotEnoughEpisodesError, match="2 target_too_small"):
        generate_episodes([short], demo, robot, SUPPORT, params, lambda share, text: None)


def test_poses_off_the_table_or_out_of_reach_are_not_tried(fitted: FittedAsset) -> None:
    shoulder = np.array([0.0, 0.0, 0.16])
    T = fitted.T_world_asset[:2, 3]
    small = SupportPlane(height=0.05, low_xy=T - 0.3, high_xy=T + 0.3)
    here = Variation(seed=0, index=0, x=0, y=0, yaw=0)
    assert worth_trying(here, fitted, small, shoulder, 1.1)
    assert not worth_trying(replace(here, y=0.3), fitted, small, shoulder, 1.1)
    assert worth_trying(replace(here, y=0.3), fitted, SUPPORT, shoulder, 1.1)
    assert not worth_trying(replace(here, x=0.5), fitted, SUPPORT, shoulder, 1.1)
    # The recorded place counts as table even where its edge is estimated too near.
    assert worth_trying(here, fitted, replace(small, high_xy=T - 0.1), shoulder, 1.1)


def test_a_pose_that_a_camera_does_not_show_is_not_in_view(fitted: FittedAsset) -> None:
    here = Variation(seed=0, index=0, x=0.0, y=0.0, yaw=0.0)
    held = apply(fitted.T_world_asset, fitted.contact_asset)
    camera = Camera(
        fx=300, fy=300, cx=160, cy=120, width=320, height=240,
        T_world_cam=look_at(held + [-1.5, -1.0, 0.8], held),
    )  # fmt: skip
    assert in_view(here, fitted, camera, 0.85)
    assert not in_view(replace(here, x=-1.2, y=1.8), fitted, camera, 0.85)
    behind = camera.moved(look_at(held + [-1.5, -1.0, 0.8], held + [-3.0, -2.0, 1.6]))
    assert not in_view(here, fitted, behind, 0.85)
    zoomed = replace(camera, fx=9000, fy=9000)
    assert not in_view(here, fitted, zoomed, 0.85)
    assert not in_view(here, fitted, zoomed, 0.0), "the held point leaves the picture while the part opens"
