"""Plans follow the object, keep the arm's limits, and say no where they must."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.boxes import OrientedBox
from aomgen.core.demonstration import Demonstration, gripper_command, timing
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation, VerifiedEpisode
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, transform
from aomgen.episodes.grasps import Grasp, grasps, orientations
from aomgen.episodes.ik import IkSolver
from aomgen.episodes.joint_limits import IkLimits
from aomgen.episodes.planning import Planner, PlanParams, plan_episode
from aomgen.episodes.retarget import CONTACT, NEAR_M, ROOM, DemonstratedMotion, RetargetedMotion
from aomgen.robots.robot import RobotModel
from aomgen.simulation.collision_check import KinematicLimits, check_kinematics
from aomgen.simulation.scene import Scene, build_scene
from aomgen.simulation.verify import verify_plan
from backwards import closing_of
from toy_drawer import SUPPORT, opening


def grasp_of(demo: Demonstration, fitted: FittedAsset) -> Grasp:
    R = fitted.T_world_asset[:3, :3].T @ demo.Ts_world_ee[demo.contact_frames[0], :3, :3]
    return next(iter(grasps(fitted, R, [0.0], demo.ee_turn_ratio)))


def motion_of(
    demo: Demonstration, fitted: FittedAsset, T_world_object: np.ndarray, **more
) -> RetargetedMotion:
    shown = DemonstratedMotion(demo)
    grasp = grasp_of(demo, fitted)
    return RetargetedMotion(shown=shown, fitted=fitted, T_world_object=T_world_object, grasp=grasp, **more)


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


def test_fingers_come_wider_than_a_thick_handle(demo: Demonstration) -> None:
    """Whoever came to a thin rim with fingers half closed opens them for a thick one, and closes fully on both."""
    half = replace(demo, gripper=0.5 + 0.3 * demo.gripper / demo.gripper.max())
    shown = DemonstratedMotion(half)
    times = shown.times
    came, wider = shown.gripper(times, 0.8), shown.gripper(times, 0.4)
    assert came.min() == pytest.approx(0.5)
    assert wider.min() == pytest.approx(0.4 - ROOM)
    for command in (came, wider):
        assert np.all(command[demo.contact_frames] == 1)
    assert np.all(np.diff(came) * np.diff(wider) >= 0)


def test_same_object_at_the_same_place_gives_the_demonstrated_motion(
    demo: Demonstration, fitted: FittedAsset
) -> None:
    motion = motion_of(demo, fitted, fitted.T_world_asset)
    shown = motion.shown
    times = shown.times[shown.times >= shown.marks[1]]
    there = shown.poses(times)
    assert 1000 * np.abs(motion.at(times)[:, :3, 3] - there[:, :3, 3]).max() < 12
    np.testing.assert_allclose(motion.at(times)[:, :3, :3], there[:, :3, :3], atol=1e-3)
    free = shown.times[shown.times < shown.marks[1]]
    joints = shown.bend(free, demo.joints[0], shown.joints(shown.marks[1:2])[0])
    np.testing.assert_allclose(joints, shown.joints(free), atol=1e-9)


def test_contact_segment_moves_rigidly_with_the_object(demo: Demonstration, fitted: FittedAsset) -> None:
    T = Variation(seed=0, index=0, x=0.04, y=-0.03, yaw=0.3).place_at(fitted)
    there, here = motion_of(demo, fitted, T), motion_of(demo, fitted, fitted.T_world_asset)
    moments = there.shown.moments
    times = np.linspace(moments.close, moments.free, 40)
    np.testing.assert_allclose(there.at(times), T @ invert(fitted.T_world_asset) @ here.at(times), atol=1e-9)
    held = apply(there.at(times), there.grasp.held_ee[None])
    handle = apply(T @ fitted.asset.joint.motion(there.thetas(times)), fitted.contact_asset[None])
    np.testing.assert_allclose(held, handle, atol=1e-9)


def test_a_straight_approach_ends_at_the_handle_and_backs_off_little(
    demo: Demonstration, fitted: FittedAsset
) -> None:
    motion = motion_of(demo, fitted, fitted.T_world_asset, style="straight")
    moments, marks = motion.shown.moments, motion.shown.marks
    T_hold = motion.holding(np.array([moments.close, moments.free]))
    for times, T in ((marks[1:3], T_hold[0]), (marks[[5, 6]], T_hold[1])):
        ways = motion.at(np.linspace(*times, 20))[:, :3, 3] - T[:3, 3]
        np.testing.assert_allclose(ways - np.outer(ways @ T[:3, 2], T[:3, 2]), 0.0, atol=1e-9)
        assert np.linalg.norm(ways, axis=1).max() == pytest.approx(NEAR_M, abs=0.02)


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


def test_an_open_drawer_is_closed(
    robot: RobotModel, solver: IkSolver, demo: Demonstration, fitted: FittedAsset
) -> None:
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    variation = Variation(seed=0, index=0, x=0.03, y=0.02, yaw=0.2)
    plan = plan_episode(fitted.backwards(), closing_of(demo), variation, scene, solver, PlanParams())
    assert isinstance(plan, EpisodePlan), plan
    assert plan.thetas[0] == pytest.approx(fitted.target_theta)
    assert plan.thetas[-1] == 0.0
    made = verify_plan(plan, scene)
    assert isinstance(made, VerifiedEpisode), made
    assert made.reached.thetas[0] == pytest.approx(fitted.target_theta, abs=1e-3)
    assert abs(made.reached.thetas[-1]) < 0.01
    certificate = made.verdict.as_json()
    assert (certificate["start_theta"], certificate["target_theta"]) == (fitted.target_theta, 0.0)


def test_grasps_begin_with_the_hand_at_the_closed_part(demo: Demonstration, fitted: FittedAsset) -> None:
    """The hinge of a new object may be on the other side: only there do hands compare."""
    turns = matrix_from_rotvec(np.linspace(0.0, 1.0, len(demo.times_s))[:, None] * np.array([0.0, 0.0, 1.0]))
    turning = replace(demo, Ts_world_ee=transform(turns @ demo.Ts_world_ee[:, :3, :3], np.zeros(3)))
    opened = DemonstratedMotion(turning).hand_at_closed(fitted)
    wanted = turning.Ts_world_ee[demo.contact_frames[0], :3, :3]
    np.testing.assert_allclose(fitted.T_world_asset[:3, :3] @ opened, wanted, atol=1e-6)
    closed = DemonstratedMotion(closing_of(turning)).hand_at_closed(fitted.backwards())
    np.testing.assert_allclose(closed, opened, atol=1e-6)


def test_a_plan_keeps_the_asked_speed_and_start(
    robot: RobotModel, solver: IkSolver, demo: Demonstration, fitted: FittedAsset
) -> None:
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    here = Variation(seed=0, index=0, x=0.03, y=0.02, yaw=0.2)
    offset = (0.1, -0.1, 0.05, 0.1, -0.1, 0.2)

    def planned(**changes: object) -> EpisodePlan:
        plan = plan_episode(fitted, demo, replace(here, **changes), scene, solver, PlanParams())  # pyright: ignore[reportArgumentType]
        assert isinstance(plan, EpisodePlan), plan
        return plan

    usual, slow, elsewhere = planned(), planned(speed=0.5), planned(start_offset=offset)
    assert len(slow) == pytest.approx(2 * len(usual), abs=2)
    np.testing.assert_allclose(elsewhere.joints[0], demo.joints[0] + offset, atol=1e-3)
    # It has come back to the usual way before it moves with the object.
    first = int(np.argmax(elsewhere.phases == CONTACT))
    back = len(usual) - int(np.argmax(usual.phases == CONTACT))
    assert len(elsewhere) - first == pytest.approx(back, abs=1)
    np.testing.assert_allclose(elsewhere.joints[first:][:40], usual.joints[-back:][:40], atol=0.03)


@pytest.mark.parametrize("free", ["demonstrated", "searched"])
def test_the_free_motion_keeps_the_joint_limits(
    robot: RobotModel, fitted: FittedAsset, solver: IkSolver, free: Literal["demonstrated", "searched"]
) -> None:
    demo = opening(solver, fitted, before=(0.28, -0.4, 0.0))
    furthest, margin = demo.joints[:, 0].max(), IkLimits().limit_margin
    assert furthest == demo.joints[0, 0]

    def planned(room: float, offset: float) -> EpisodePlan | Rejection:
        limits = np.array(robot.joint_limits)
        limits[0, 1] = furthest + room
        narrow = replace(robot, joint_limits=limits)
        scene = build_scene(narrow, fitted.asset, fitted.T_world_asset, SUPPORT)
        here = Variation(seed=0, index=0, x=0.0, y=0.0, yaw=0.0, start_offset=(offset, *np.zeros(5)))
        planner = Planner(fitted, demo, here, scene, replace(solver, robot=narrow), PlanParams())
        found = planner.search(planner.list_motions(), [("straight", free)])
        return found if isinstance(found, Rejection) else found[1]

    for room, offset in ((margin + 0.03, 0.025), (0.5 * margin, 0.0)):
        plan = planned(room, offset)
        assert isinstance(plan, EpisodePlan), plan
        assert plan.joints[:, 0].max() <= furthest + offset + 1e-6
    for room, offset in ((margin + 0.03, 0.035), (0.5 * margin, 0.001), (0.03, 0.05)):
        refused = planned(room, offset)
        assert isinstance(refused, Rejection), (room, offset)
        assert refused.reason == "joint_limit"


def test_a_free_motion_past_a_limit_is_refused(
    robot: RobotModel, solver: IkSolver, demo: Demonstration, fitted: FittedAsset
) -> None:
    """Both ends of the demonstrated free motion keep the limit, and its middle does not."""
    limits = np.array(robot.joint_limits)
    middle = demo.joints.copy()
    middle[4:8, 0] += 0.5
    limits[0, 1] = demo.joints[:, 0].max() + 0.1
    narrow, there = replace(robot, joint_limits=limits), Variation(seed=0, index=0, x=0.0, y=0.0, yaw=0.0)
    scene = build_scene(narrow, fitted.asset, fitted.T_world_asset, SUPPORT)
    planner = Planner(fitted, demo, there, scene, replace(solver, robot=narrow), PlanParams())
    planner.shown = DemonstratedMotion(replace(demo, joints=middle))
    found = planner.search(planner.list_motions()[:1], [("demonstrated", "demonstrated")])
    assert isinstance(found, Rejection)
    assert found.reason == "joint_limit"


def test_the_way_leads_around_what_stands_there(
    robot: RobotModel, solver: IkSolver, fitted: FittedAsset
) -> None:
    demo = opening(solver, fitted, before=(0.28, -0.4, 0.0))
    here = Variation(seed=0, index=0, x=0.0, y=0.0, yaw=0.0)

    def planned(*boxes: OrientedBox, search: bool = True) -> tuple[EpisodePlan | Rejection, Scene]:
        scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT, obstacles=boxes)
        return plan_episode(fitted, demo, here, scene, solver, PlanParams(search=search)), scene

    def column(place: np.ndarray, top: float, width: float = 0.02) -> OrientedBox:
        half = (top - SUPPORT.height) / 2
        T = transform(np.eye(3), [place[0], place[1], SUPPORT.height + half])
        return OrientedBox(T_world_box=T, half_extents=np.array([0.01, width / 2, half]))

    plain, _ = planned()
    assert isinstance(plain, EpisodePlan)
    way = plain.Ts_world_ee[plain.phases == 0, :3, 3]
    gone = np.linalg.norm(way - way[0], axis=1)
    middle = way[np.argmin(np.abs(gone - 0.5 * gone[-1]))]
    around, scene = planned(column(middle, middle[2] + 0.02))
    assert isinstance(around, EpisodePlan), around
    wall = column(middle, middle[2] + 0.06, width=0.2)
    searched, _ = planned(wall)
    assert isinstance(searched, EpisodePlan), searched
    assert searched.grasp.endswith("searched free motion")
    unsearched, _ = planned(wall, search=False)
    assert getattr(unsearched, "reason", "") == "collision"
    still = np.zeros(len(plain), bool)
    struck = check_kinematics(scene, plain.joints, 0.0 * plain.thetas, plain.thetas, still, KinematicLimits())
    assert getattr(struck, "reason", "") == "collision"
    # Neither the object's base nor its part may meet it; and the drawer's way is not to be had otherwise.
    for place in (
        plain.T_world_object[:3, 3],
        apply(plain.T_world_object, fitted.asset.handle_point) - [0.1, 0, 0],
    ):
        blocked, _ = planned(column(place, place[2] + 0.2))
        assert getattr(blocked, "reason", "") == "collision"


def test_a_part_without_a_handle_is_held_where_it_was(
    robot: RobotModel, solver: IkSolver, demo: Demonstration, fitted: FittedAsset
) -> None:
    """No collider is named as a handle: the whole part may be touched while it is held, not before."""
    moving = fitted.asset.moving
    plain = tuple(replace(box, name=box.name.replace("handle", "rim")) for box in moving.colliders)
    bare = replace(fitted, asset=replace(fitted.asset, moving=replace(moving, colliders=plain)))
    assert bare.asset.handle_bar is None
    scene = build_scene(robot, bare.asset, bare.T_world_asset, SUPPORT)
    plan = plan_episode(
        bare, demo, Variation(seed=0, index=0, x=0.02, y=0.0, yaw=0.1), scene, solver, PlanParams()
    )
    assert isinstance(plan, EpisodePlan), plan
    assert plan.metrics["grip_gap_mm"] < KinematicLimits().max_gap_mm


def test_closing_goes_back_where_opening_came_from(
    demo: Demonstration, fitted: FittedAsset, made: Callable[[str, int], ArticulatedAsset]
) -> None:
    door = replace(fitted, asset=made("microwave", 1), thetas=fitted.thetas / fitted.thetas[-1])
    opened = motion_of(demo, door, door.T_world_asset)
    opened = replace(opened, grasp=replace(opened.grasp, turn_ratio=0.8))
    start, end = opened.shown.moments.start, opened.shown.moments.end
    times = np.linspace(start, end, 20)
    poses = opened.holding(times)
    closing = replace(opened, fitted=door.backwards())
    np.testing.assert_allclose(closing.holding(start + end - times), poses, atol=1e-9)


def test_pose_out_of_reach_is_rejected_with_a_reason(
    robot: RobotModel, solver: IkSolver, demo: Demonstration, fitted: FittedAsset
) -> None:
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    far = Variation(seed=0, index=0, x=0.8, y=0.0, yaw=0.0)
    result = plan_episode(fitted, demo, far, scene, solver, PlanParams())
    assert isinstance(result, Rejection)
    assert result.reason == "unreachable"
    assert result.metrics["grasps_tried"] >= 7


@pytest.mark.parametrize("way", [0.16, 0.08, 0.02])
def test_a_film_that_begins_near_the_handle_begins_there_with_every_object(
    robot: RobotModel, solver: IkSolver, demo: Demonstration, fitted: FittedAsset, way: float
) -> None:
    """The way to the new place is not shown; the arm takes it from where it was, as fast as it can."""
    left = DemonstratedMotion(demo).distance(timing(demo).close) - DemonstratedMotion(demo).distance(
        demo.times_s
    )
    rows = slice(int(np.flatnonzero(left <= way)[0]), None)
    names = ("times_s", "joints", "gripper", "Ts_world_ee", "thetas")
    near = replace(demo, **{name: getattr(demo, name)[rows] for name in names})
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    there = Variation(seed=0, index=0, x=0.06, y=0.05, yaw=0.2)
    plan = plan_episode(fitted, near, there, scene, solver, PlanParams())
    assert isinstance(plan, EpisodePlan)
    np.testing.assert_allclose(plan.joints[0], near.joints[0], atol=0.05)
    assert plan.metrics["joint_acceleration"] <= IkLimits().acceleration
    assert isinstance(verify_plan(plan, scene), VerifiedEpisode)


def test_a_motion_too_fast_for_the_arm_is_slowed_down_as_far_as_allowed(
    robot: RobotModel, solver: IkSolver, demo: Demonstration, fitted: FittedAsset
) -> None:
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    near, slow_arm = Variation(seed=0, index=0, x=0.03, y=0.02, yaw=0.2), IkLimits(speed=0.3)
    plan, refused = (
        plan_episode(fitted, demo, near, scene, solver, PlanParams(ik=slow_arm, max_slow_down=slower))
        for slower in (3.0, 1.0)
    )
    assert isinstance(plan, EpisodePlan)
    assert plan.metrics["joint_speed"] <= 0.3
    assert len(plan) > 1.2 * len(demo.times_s)
    assert isinstance(refused, Rejection)
