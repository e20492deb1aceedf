"""Contact patches of the real gripper on hand-made parts, and the stage's file."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.core.joint_log import JointLog
from aomgen.core.motion import ContactPatch, MotionCurve, MotionEstimate
from aomgen.core.transforms import apply
from aomgen.errors import CorruptArtifactError, InputError, MissingFileError
from aomgen.io.atomic import write_json
from aomgen.motion.contact import find_contacts
from aomgen.motion.stage import FILE_NAME, load_motion
from aomgen.physics.robot import RobotModel, load_robot

JOINTS = np.array([3.9, -1.8, 2.2, -0.4, 2.0, 0.0])


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return load_robot("ur5e_2f85")


def still_log(robot: RobotModel, gripper: float) -> JointLog:
    return JointLog(
        times_s=np.array([0.0, 2.0]), joints=np.stack([JOINTS, JOINTS]), gripper=np.full(2, gripper),
        joint_names=robot.joint_names,
    )  # fmt: skip


def bar(length_m: float, radius_m: float, along_m: float) -> np.ndarray:
    """Points of a bar across the fingers, `along_m` beyond the pinch point, end-effector frame."""
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(-length_m / 2, length_m / 2, 3000)
    return np.stack([height, radius_m * np.cos(angle), along_m + radius_m * np.sin(angle)], 1)


@pytest.mark.parametrize("along_m", [0.0, 0.008])
def test_both_fingers_touch_the_bar_where_it_is(robot: RobotModel, along_m: float) -> None:
    T_world_ee = robot.ee_poses(JOINTS[None])[0]
    points = apply(T_world_ee, bar(0.1, 0.012, along_m))
    contacts = find_contacts(robot, still_log(robot, 0.68), points, 0.5)
    middle = np.mean([patch.point for patch in contacts.patches], axis=0)
    assert {patch.finger for patch in contacts.patches} == {"left", "right"}
    assert np.linalg.norm(middle - apply(T_world_ee, [0, 0, along_m])) < 0.004
    assert contacts.grasp_ee == pytest.approx([0, 0, along_m], abs=0.004)
    for patch in contacts.patches:
        assert patch.normal @ (middle - patch.point) > 0
        assert np.linalg.norm(patch.normal) == pytest.approx(1)


def test_a_gap_shows_how_far_the_alignment_is_off(robot: RobotModel) -> None:
    T_world_ee = robot.ee_poses(JOINTS[None])[0]
    far = apply(T_world_ee, bar(0.1, 0.012, 0.05))
    contacts = find_contacts(robot, still_log(robot, 0.68), far, 0.5)
    assert min(patch.gap_m for patch in contacts.patches) > 0.01


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
        times_s=times, thetas=times * 2, theta_sd=times, slip_m=times * 0, part_odds=9.0,
    )  # fmt: skip


def test_an_estimate_survives_the_disk(tmp_path: Path) -> None:
    write_json(tmp_path / FILE_NAME, asdict(estimate()))
    loaded = load_motion(tmp_path)
    assert loaded.contacts[0].finger == "left"
    assert loaded.joint.axis == pytest.approx([0, 0, -1])
    assert loaded.thetas == pytest.approx(estimate().thetas)
    assert loaded.theta_at([0.05, 9.0]) == pytest.approx([0.1, 0.8])


def test_a_missing_or_foreign_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError):
        load_motion(tmp_path)
    write_json(tmp_path / FILE_NAME, {"joint": {}})
    with pytest.raises(CorruptArtifactError, match="not a motion estimate"):
        load_motion(tmp_path)


def test_a_part_without_points_is_named() -> None:
    from aomgen.motion.edges import upright_box

    with pytest.raises(InputError, match="3 points"):
        upright_box(np.zeros((3, 3)), 0.0)
