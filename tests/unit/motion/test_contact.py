"""Contact patches of the real gripper on hand-made parts, and the stage's file."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.core.motion import ContactPatch, MotionCurve, MotionEstimate
from aomgen.core.recording import JointLog
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, rotvec_from_matrix, transform
from aomgen.errors import InputError
from aomgen.io.artifact import load_artifact, save_artifact
from aomgen.motion.contact import Contacts, carry_part, find_between_pads, find_contacts
from aomgen.motion.inputs import MotionInput
from aomgen.robots import gripper_surface
from aomgen.robots.robot import RobotModel
from filmed_panel import world

JOINTS = np.array([3.9, -1.8, 2.2, -0.4, 2.0, 0.0])
# Of a world in which no bar's side is across the pads' closing.
AXES = matrix_from_rotvec([0.4, 0.5, 0.6])


def still_log(robot: RobotModel, gripper: float) -> JointLog:
    return JointLog(
        times_s=np.array([0.0, 2.0]), joints=np.stack([JOINTS, JOINTS]), gripper=np.full(2, gripper),
        joint_names=robot.joint_names,
    )  # fmt: skip


def hand(robot: RobotModel, log: JointLog) -> MotionInput:
    """A demonstration of which only the hand matters."""
    return replace(_filmed(), robot=robot, log=log)


@cache
def _filmed() -> MotionInput:
    return world().demo


def bar(length_m: float, radius_m: float, along_m: float, lean: float = 0.0) -> np.ndarray:
    """Points of a bar across the fingers, `along_m` beyond the pinch point, end-effector frame."""
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 6000), rng.uniform(-length_m / 2, length_m / 2, 6000)
    points = np.stack([height, radius_m * np.cos(angle), radius_m * np.sin(angle)], 1)
    return points @ matrix_from_rotvec([0, -lean, 0]).T + [0, 0, along_m]


def find(robot: RobotModel, log: JointLog, points: np.ndarray, axes: np.ndarray = AXES) -> Contacts:
    """Patches and held point of a hand that carries the part from 0.5 s on."""
    times = 0.5 + np.linspace(0, 0.3, 4)
    demo = hand(robot, log)
    return find_contacts(demo, (points, axes), times, carry_part(demo, 0.5, times))


def middle_ee(robot: RobotModel, patches: tuple[ContactPatch, ...]) -> np.ndarray:
    T_world_ee = robot.ee_poses(JOINTS[None])[0]
    return apply(invert(T_world_ee), np.mean([patch.point for patch in patches], axis=0))


@pytest.mark.parametrize("along_m", [0.0, 0.008])
def test_both_fingers_touch_the_bar_where_it_is(robot: RobotModel, along_m: float) -> None:
    points = apply(robot.ee_poses(JOINTS[None])[0], bar(0.1, 0.006, along_m))
    log = still_log(robot, 0.857)
    patches, grasp_ee = find(robot, log, points)
    assert {patch.finger for patch in patches} == {"left", "right"}
    assert middle_ee(robot, patches) == pytest.approx([0, 0, along_m], abs=0.006)
    assert grasp_ee == pytest.approx(middle_ee(robot, patches), abs=1e-9)
    assert all(0.004 < patch.spread_m < 0.014 for patch in patches)
    middle = np.mean([patch.point for patch in patches], axis=0)
    for patch in patches:
        assert patch.normal @ (middle - patch.point) > 0
        assert np.linalg.norm(patch.normal) == pytest.approx(1)


def test_a_leaning_bar_is_pressed_where_the_pads_come_nearest(robot: RobotModel) -> None:
    """Loaded in MuJoCo, this gripper's pads meet tips first: at (-10, 4) mm for a round bar leaning by 20 deg."""
    points = apply(robot.ee_poses(JOINTS[None])[0], bar(0.1, 0.006, 0.0, lean=-np.radians(20)))
    log = still_log(robot, 0.857)
    middle = middle_ee(robot, find(robot, log, points)[0])
    assert middle[0] < -0.004
    assert middle[2] > 0.003


def test_a_bar_of_few_points_is_followed_across_the_pads(robot: RobotModel) -> None:
    """Fifteen points on 10 cm of a leaning bar, and those between the pads taken away, still tell its line."""
    log, T_world_ee = still_log(robot, 0.857), robot.ee_poses(JOINTS[None])[0]
    sparse = bar(0.1, 0.003, 0.0, lean=-np.radians(20))[::120]
    sparse = sparse[np.abs(sparse[:, 0]) > 0.005]
    middle = middle_ee(robot, find(robot, log, apply(T_world_ee, sparse))[0])
    assert middle[0] < -0.003
    assert abs(middle[2] + np.tan(np.radians(20)) * middle[0]) < 0.005


def test_what_a_bar_is_mounted_on_is_not_taken_for_it(robot: RobotModel) -> None:
    """Nine points of a leaning bar in three places and a dense wall 35 mm behind: the bar's line is told."""
    log, T_world_ee = still_log(robot, 0.857), robot.ee_poses(JOINTS[None])[0]
    lean = matrix_from_rotvec([0, np.radians(20), 0])
    places = np.array([-0.03, -0.028, -0.026, -0.008, -0.006, -0.004, 0.014, 0.016, 0.018])
    seen = np.stack([places, np.zeros(9), np.zeros(9)], 1)
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.1, 0.1, 81), np.linspace(-0.05, 0.05, 41)))
    wall = np.stack([u, v, np.full(len(u), 0.035)], 1)
    points = apply(T_world_ee, np.concatenate([seen, wall]) @ lean.T)
    axes = (T_world_ee[:3, :3] @ lean).T
    middle = middle_ee(robot, find(robot, log, points, axes)[0])
    bare = middle_ee(robot, find(robot, log, points[:9], axes)[0])
    assert middle == pytest.approx(bare, abs=1e-3)
    # Pressed where the pads come nearest: at the end and on the side of the bar that are nearest to the tips.
    assert middle[0] < -0.004
    assert 0.0 < middle[2] + np.tan(np.radians(20)) * middle[0] < 0.010


def test_a_bar_goes_on_where_it_was_not_seen(robot: RobotModel) -> None:
    """Seen from one side of the pads to their middle only, it is pressed at their other edge all the same."""
    log, T_world_ee = still_log(robot, 0.857), robot.ee_poses(JOINTS[None])[0]
    lean = matrix_from_rotvec([0, np.radians(20), 0])
    half = np.stack([np.linspace(-0.001, 0.05, 30), np.zeros(30), np.zeros(30)], 1) @ lean.T
    axes = (T_world_ee[:3, :3] @ lean).T
    patches, _ = find(robot, log, apply(T_world_ee, half), axes)
    assert middle_ee(robot, patches)[0] < -0.004


def test_what_the_scan_did_not_see_is_held_all_over_the_pads(robot: RobotModel) -> None:
    """Fingers closed on a handle of which nothing was reconstructed; the rest of the part is beside the palm."""
    log, T_world_ee = still_log(robot, 0.857), robot.ee_poses(JOINTS[None])[0]
    part = np.random.default_rng(0).uniform([0.08, 0.05, -0.1], [0.3, 0.06, -0.05], (500, 3))
    away = transform(np.eye(3), T_world_ee[:3, :3] @ [-0.01, 0, 0])
    path = np.array([0.5, 0.6]), np.stack([np.eye(4), away])
    patches, _ = find_contacts(hand(robot, log), (apply(T_world_ee, part), AXES), *path)
    assert {patch.finger for patch in patches} == {"left", "right"}
    assert middle_ee(robot, patches) == pytest.approx([0, 0, 0], abs=0.01)
    assert min(patch.spread_m for patch in patches) > 0.008


def test_a_plate_between_the_pads_is_no_bar(robot: RobotModel) -> None:
    """The edge of a lid that fills the pads: the touch lies in the middle of their width."""
    log, T_world_ee = still_log(robot, 0.857), robot.ee_poses(JOINTS[None])[0]
    u, v, w = (grid.ravel() for grid in np.meshgrid(
        np.linspace(-0.1, 0.1, 81), [-0.006, 0.006], np.linspace(-0.008, 0.1, 44)
    ))  # fmt: skip
    patches, _ = find(robot, log, apply(T_world_ee, np.stack([u, v, w], 1)))
    assert middle_ee(robot, patches)[:2] == pytest.approx([0, 0], abs=0.002)
    assert middle_ee(robot, patches)[2] > 0.005


def box_bar(
    roll_rad: float, at_m: tuple[float, float] = (0.0, 0.0), deep_m: float = 0.012
) -> tuple[np.ndarray, np.ndarray]:
    """Points of a bar 12 mm thick across the fingers, turned about its length, and its axes; end-effector frame."""
    turn = matrix_from_rotvec([roll_rad, 0, 0])
    rng = np.random.default_rng(0)
    section = rng.uniform(-0.5, 0.5, (6000, 2)) * [0.012, deep_m]
    side = rng.integers(0, 4, 6000)
    section[side < 2, 0] = 0.006 * (2 * side[side < 2] - 1)
    section[side >= 2, 1] = deep_m / 2 * (2 * side[side >= 2] - 5)
    points = np.column_stack([rng.uniform(-0.05, 0.05, 6000), section]) @ turn.T + [0, *at_m]
    return points, turn.T


def touches_ee(robot: RobotModel, points_ee: np.ndarray, axes_ee: np.ndarray) -> dict[str, np.ndarray]:
    """Where each finger touches, end-effector frame."""
    log, T_world_ee = still_log(robot, 0.857), robot.ee_poses(JOINTS[None])[0]
    axes = axes_ee @ T_world_ee[:3, :3].T
    patches, _ = find(robot, log, apply(T_world_ee, points_ee), axes)
    return {patch.finger: apply(invert(T_world_ee), patch.point) for patch in patches}


@pytest.mark.parametrize("roll_deg", [-10.0, 10.0])
def test_a_bar_that_is_turned_in_the_pads_is_touched_at_opposite_edges(
    robot: RobotModel, roll_deg: float
) -> None:
    touches = touches_ee(robot, *box_bar(np.radians(roll_deg)))
    near, far = sorted(touches, key=lambda finger: touches[finger][1])
    assert touches[near][2] * np.sign(roll_deg) > 0.004
    assert touches[far][2] * np.sign(roll_deg) < -0.004
    assert np.mean(list(touches.values()), axis=0) == pytest.approx([0, 0, 0], abs=0.002)


def test_a_bar_that_lies_flush_is_touched_on_the_side_of_the_tips(robot: RobotModel) -> None:
    """The pads of this gripper are 1.5 degrees from parallel each, and nearest to each other at their tips."""
    for touch in touches_ee(robot, *box_bar(0.0)).values():
        assert 0.003 < touch[2] < 0.008


def test_a_lid_held_by_its_rim_is_touched_by_a_tip_and_at_the_rim(robot: RobotModel) -> None:
    """A plate at 40 degrees to the pads, whose rim is 6 mm within them."""
    points, axes = box_bar(np.radians(40), deep_m=0.2)
    pads = touches_ee(robot, *box_bar(0.0))
    tip = 0.018
    rim = axes[2] * 0.1
    touches = touches_ee(robot, points + [0, 0, tip - 0.006] + rim, axes)
    assert {*touches} == {*pads}
    low, high = sorted(float(touch[2]) for touch in touches.values())
    assert high == pytest.approx(tip, abs=0.001)
    # The nearer edge of a rim 12 mm thick.
    assert low == pytest.approx(tip - 0.006 - 0.006 * np.sin(np.radians(40)), abs=0.003)
    assert np.mean([touch[0] for touch in touches.values()]) == pytest.approx(0, abs=0.003)


def test_only_what_a_gripper_holds_lies_between_its_pads(robot: RobotModel) -> None:
    """A bar to the pads' width, and not the wall behind it; nothing where the hand is closed upon itself."""
    T_world_ee = robot.ee_poses(JOINTS[None])[0]
    held, wall = bar(0.1, 0.006, 0.0), bar(0.1, 0.006, 0.06)
    points = apply(T_world_ee, np.concatenate([held, wall]))
    between = find_between_pads(hand(robot, still_log(robot, 0.857)), 0.5, points)
    assert between[:6000][np.abs(held[:, 0]) < 0.008].all()
    assert not between[:6000][np.abs(held[:, 0]) > 0.025].any()
    assert not between[6000:].any()
    assert not find_between_pads(hand(robot, still_log(robot, 1.0)), 0.5, points).any()


def test_strays_behind_the_bar_draw_nothing(robot: RobotModel) -> None:
    T_world_ee = robot.ee_poses(JOINTS[None])[0]
    log = still_log(robot, 0.857)
    points = bar(0.1, 0.006, 0.0)
    strays = np.random.default_rng(1).uniform([-0.01, -0.004, 0.012], [0.01, 0.004, 0.018], (12, 3))
    clean, dirty = (
        middle_ee(robot, find(robot, log, apply(T_world_ee, item))[0])
        for item in (points, np.concatenate([points, strays]))
    )
    assert dirty == pytest.approx(clean, abs=0.004)


def test_the_part_is_sought_where_it_is_and_not_where_it_was(robot: RobotModel) -> None:
    """A part that has gone 15 mm with the hand since the scan is held where it is now."""
    T_world_ee = robot.ee_poses(JOINTS[None])[0]
    log = still_log(robot, 0.857)
    gone = transform(np.eye(3), T_world_ee[:3, :3] @ [0, 0, -0.015])
    scanned = apply(invert(gone), apply(T_world_ee, bar(0.1, 0.006, 0.0)))
    path = np.array([0.5, 0.6]), np.stack([gone, gone])
    patches, _ = find_contacts(hand(robot, log), (scanned, AXES), *path)
    assert middle_ee(robot, patches) == pytest.approx([0, 0, 0], abs=0.006)
    held, _ = find(robot, log, scanned)
    assert middle_ee(robot, held)[2] > 0.01


def test_a_hand_turned_in_the_world_takes_its_patches_along(robot: RobotModel) -> None:
    other = JOINTS + [0.7, 0.1, -0.2, 0.3, 0.2, 0.4]
    points, found = bar(0.1, 0.006, 0.003), []
    axes_ee = AXES @ robot.ee_poses(JOINTS[None])[0][:3, :3]
    for joints in (JOINTS, other):
        log = JointLog(
            times_s=np.array([0.0, 2.0]), joints=np.stack([joints] * 2), gripper=np.full(2, 0.857),
            joint_names=robot.joint_names,
        )  # fmt: skip
        T_world_ee = robot.ee_poses(joints[None])[0]
        axes = axes_ee @ T_world_ee[:3, :3].T
        patches, _ = find(robot, log, apply(T_world_ee, points), axes)
        found.append([apply(invert(T_world_ee), patch.point) for patch in patches])
    assert np.array(found[0]) == pytest.approx(np.array(found[1]), abs=1e-5)


def moving_log(robot: RobotModel, gripper: float, way_ee: np.ndarray) -> JointLog:
    """The hand goes about `way_ee` within 0.3 s from 0.5 s."""
    step = 1e-4
    base = robot.ee_poses(JOINTS[None])[0]
    moved = robot.ee_poses(JOINTS + step * np.eye(6))
    slope = np.concatenate(
        [(moved[:, :3, 3] - base[:3, 3]), rotvec_from_matrix(moved[:, :3, :3] @ base[:3, :3].T)], 1
    ).T / step  # fmt: skip
    turn = np.linalg.lstsq(slope, np.concatenate([base[:3, :3] @ way_ee, np.zeros(3)]), rcond=None)[0]
    return JointLog(
        times_s=np.array([0.0, 0.5, 0.8, 2.0]), joints=np.stack([JOINTS, JOINTS, JOINTS + turn, JOINTS + turn]),
        gripper=np.full(4, gripper), joint_names=robot.joint_names,
    )  # fmt: skip


def test_a_closed_gripper_pushes_with_its_tips(robot: RobotModel) -> None:
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-0.1, 0.1, 101)] * 2))
    tip = tip_m(robot)
    door = np.stack([u, v, np.full(len(u), tip + 0.002)], 1)
    log = moving_log(robot, 1.0, np.array([0, 0, 0.02]))
    patches, grasp_ee = find(robot, log, apply(robot.ee_poses(JOINTS[None])[0], door))
    assert {patch.finger for patch in patches} == {"left", "right"}
    assert grasp_ee == pytest.approx([0, 0, tip], abs=0.006)
    assert min(patch.gap_m for patch in patches) < 0.005


def test_pushed_patches_are_where_a_denser_hand_has_them(
    robot: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which points stand for the hand's surface makes half a millimeter of a difference."""
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-0.1, 0.1, 101)] * 2))
    door = np.stack([u, v, np.full(len(u), tip_m(robot) + 0.001)], 1)
    log, T_world_ee = moving_log(robot, 0.98, np.array([0, 0, 0.02])), robot.ee_poses(JOINTS[None])[0]
    leans = [matrix_from_rotvec(0.15 * np.array([np.cos(a), np.sin(a), 0])) for a in np.arange(6)]

    def touched() -> np.ndarray:
        return np.array([find(robot, log, apply(T_world_ee, door @ lean.T))[1] for lean in leans])

    usual = touched()
    monkeypatch.setattr(gripper_surface, "POINTS", 16 * gripper_surface.POINTS)
    assert np.sqrt(np.mean(np.sum((touched() - usual) ** 2, axis=1))) < 6e-4


def tip_m(robot: RobotModel) -> float:
    from aomgen.robots.gripper_surface import hand_surface

    bodies = robot.link_poses(JOINTS[None], np.array([1.0]))[0]
    points, _ = hand_surface(robot).pose(invert(robot.ee_poses(JOINTS[None])[0]) @ bodies)
    return float(points[:, 2].max())


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_closed_fingers_hook_a_bar_with_their_side(robot: RobotModel, side: float) -> None:
    """The bar runs across the closed fingers, beside them where the hand goes."""
    log = moving_log(robot, 1.0, np.array([0.02 * side, 0, 0]))
    tip = tip_m(robot)
    post = bar(0.1, 0.005, 0.0)[:, [1, 0, 2]] + [side * 0.018, 0, tip - 0.012]
    door = np.stack(
        [*(grid.ravel() for grid in np.meshgrid(*[np.linspace(-0.1, 0.1, 81)] * 2)), np.full(6561, 0)], 1
    )
    points = np.concatenate([post, door + [0, 0, tip + 0.004]])
    points = apply(robot.ee_poses(JOINTS[None])[0], points)
    patches, grasp_ee = find(robot, log, points)
    assert {patch.finger for patch in patches} <= {"left", "right"}
    assert grasp_ee == pytest.approx([side * 0.012, 0, tip - 0.012], abs=0.006)
    normal_ee = robot.ee_poses(JOINTS[None])[0, :3, :3].T @ patches[0].normal
    assert side * normal_ee[0] > 0.8


@pytest.mark.parametrize(("way", "finger"), [(-0.02, "left"), (0.02, "right")])
def test_a_hook_pulls_with_the_finger_that_faces_its_way(robot: RobotModel, way: float, finger: str) -> None:
    """An open hand goes sideways with a post on the outside of each finger: one of them is pushed."""
    log = moving_log(robot, 0.0, np.array([0, way, 0]))
    bodies = robot.link_poses(JOINTS[None], np.array([0.0]))[0]
    T_ee_world = invert(robot.ee_poses(JOINTS[None])[0])
    faces = {pad.finger: apply(T_ee_world @ bodies[pad.body], pad.face_body)[1] for pad in robot.pads}
    posts = [bar(0.1, 0.005, 0.0) + [0, y + np.sign(y) * 0.03, 0] for y in faces.values()]
    patches, _ = find(robot, log, apply(invert(T_ee_world), np.concatenate(posts)))
    assert [patch.finger for patch in patches] == [finger]
    assert np.sign(faces[finger]) == np.sign(way)


def test_a_gap_shows_how_far_the_alignment_is_off(robot: RobotModel) -> None:
    far = apply(robot.ee_poses(JOINTS[None])[0], bar(0.1, 0.006, 0.06))
    log = still_log(robot, 0.857)
    patches, _ = find(robot, log, far)
    assert min(patch.gap_m for patch in patches) > 0.01
    assert min(patch.spread_m for patch in patches) > 0.008


def estimate() -> MotionEstimate:
    times = np.arange(5) / 10
    curve = MotionCurve(
        times_s=times,
        scores=times,
        smoothed=times,
        threshold=0.1,
        distances_m=times,
        speeds_m_s=times,
        gripper=times,
    )
    patch = ContactPatch(finger="left", point=[0.5, 0, 0.2], normal=[0, 1, 0], spread_m=0.004, gap_m=0.001)
    return MotionEstimate(
        clock_offset_s=0.7, clock_offset_sd_s=0.002, start_s=0.1, end_s=0.3, curve=curve, contacts=(patch,),
        grasp_ee=[0, 0, 0.005], axis_sd_rad=0.01, origin_sd_m=0.004, axis_ci95_rad=0.017, origin_ci95_m=0.007, type_margin=30.0, ee_turn_ratio=0.9,
        joint=Joint(type="revolute", axis=[0, 0, -1], origin=[0.6, 0.2, 0], lower=0, upper=1.1),
        times_s=times, thetas=times * 2, theta_sd=times, slip_m=times * 0, pivot_rad=times * 0, direction="closing",
        part_odds=9.0,
    )  # fmt: skip


def test_an_estimate_survives_the_disk(tmp_path: Path) -> None:
    save_artifact(tmp_path, "motion", estimate())
    loaded = load_artifact(tmp_path, "motion", MotionEstimate)
    assert loaded.contacts[0].finger == "left"
    assert loaded.direction == "closing"
    assert loaded.joint.axis == pytest.approx([0, 0, -1])
    assert loaded.thetas == pytest.approx(estimate().thetas)
    assert loaded.theta_at([0.05, 9.0]) == pytest.approx([0.1, 0.8])


def test_a_part_without_points_is_named() -> None:
    from aomgen.core.boxes import fit_box

    with pytest.raises(InputError, match="3 points"):
        fit_box(np.zeros((3, 3)), np.eye(3))
