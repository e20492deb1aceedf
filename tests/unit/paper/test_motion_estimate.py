"""The paper's estimators on a hand-made door that faces the robot, whose hand draws back from it."""

import numpy as np
import pytest

from aomgen.conventions import MOVING, STATIC
from aomgen.core.alignment import Clock
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import gaussians_of
from aomgen.core.motion import MotionCurve
from aomgen.core.recording import JointLog
from aomgen.core.transforms import angle_between, apply, invert
from aomgen.errors import InputError, NoMotionError
from aomgen.io.video import Video
from aomgen.motion.inputs import MotionInput
from aomgen.paper.mask_keyframes import PartMasks, change_masks
from aomgen.paper.motion_estimate import contact_path, estimate_motion_paper, nearest_pair
from aomgen.robots.robot import RobotModel

# The hand points along -x at the door; then shoulder and elbow draw it back by some centimeters.
JOINTS = np.array([0.0, -1.2, 1.6, -0.4, 1.57, 0.0])
DRAWN = np.array([0.0, -1.2, 1.9, -0.7, 1.57, 0.0])
FRAMES, FIRST, LAST = 200, 90, 110
HINGE_Y = 0.2
OFFSET_S = 0.3
TIMES_S = np.arange(FRAMES) / 20.0


def drawing_log(robot: RobotModel) -> JointLog:
    """The hand draws back from one keyframe to the other."""
    return JointLog(
        times_s=OFFSET_S + np.array([-1.0, TIMES_S[FIRST], TIMES_S[LAST], 20.0]),
        joints=np.stack([JOINTS, JOINTS, DRAWN, DRAWN]),
        gripper=np.zeros(4),
        joint_names=robot.joint_names,
    )


def plate(low: tuple, high: tuple, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, (4000, 3))


@pytest.fixture(scope="module")
def demonstration(robot: RobotModel) -> MotionInput:
    """A door in front of the fingertips, hinged at y = 0.2, and a body behind it."""
    poses = robot.link_poses(JOINTS[None], [0.0])[0]
    tips = np.concatenate([apply(poses[mesh.body], mesh.vertices_body) for mesh in robot.meshes])
    front, (_, side, height) = tips[:, 0].min() - 0.002, robot.ee_poses(JOINTS[None])[0, :3, 3]
    door = plate((front - 0.02, side - 0.04, height - 0.1), (front, HINGE_Y, height + 0.1), 0)
    body = plate((front - 0.3, side - 0.04, height - 0.1), (front - 0.025, HINGE_Y, height + 0.1), 1)
    means = np.concatenate([door, body])
    count = len(means)
    pose = look_at((1.5, 1.5, 0.8), (0.4, 0.0, 0.0))
    return MotionInput(
        video=Video(times_s=TIMES_S, frames_srgb=np.zeros((FRAMES, 12, 16, 3), np.uint8), fps=20.0),
        camera=Camera(fx=15, fy=15, cx=8, cy=6, width=16, height=12, T_world_cam=pose),
        log=drawing_log(robot).shift(OFFSET_S),
        robot=robot,
        scene=gaussians_of(
            means=means,
            quats=np.tile([1.0, 0, 0, 0], (count, 1)),
            scales=np.full((count, 3), 0.005),
            opacities=np.full(count, 0.9),
            sh=np.zeros((count, 1, 3)),
        ),
        labels=np.repeat(np.array([MOVING, STATIC], np.uint8), len(door)),
        clock=Clock(offset_s=OFFSET_S),
    )


def sliding_masks(first: int = FIRST, last: int = LAST) -> PartMasks:
    """A square that slides by a pixel a frame between two frames."""
    moving = np.zeros((FRAMES, 40, 160), bool)
    for k, corner in enumerate(np.clip(np.arange(FRAMES) - first, 0, last - first)):
        moving[k, 10:30, 5 + corner : 25 + corner] = True
    return PartMasks(moving=moving, robot=np.zeros_like(moving))


def test_a_door_is_recovered_with_repaired_signs(demonstration: MotionInput) -> None:
    found = estimate_motion_paper(demonstration, sliding_masks(), "revolute", "repaired")
    assert [found.start_s, found.end_s] == pytest.approx([TIMES_S[FIRST], TIMES_S[LAST]], abs=0.25)
    assert np.degrees(angle_between(found.joint.axis, [0, 0, 1])) < 1e-6
    assert found.joint.origin[1] == pytest.approx(HINGE_Y, abs=0.03)
    assert found.thetas[: FIRST - 5] == pytest.approx(0.0)
    # The tips are drawn back by this much at this distance from the hinge.
    robot = demonstration.robot
    back = float(np.diff(robot.ee_poses(np.stack([JOINTS, DRAWN]))[:, 0, 3])[0])
    reach = HINGE_Y - float(found.contacts[0].point[1])
    assert back > 0.04
    assert found.thetas[-1] == found.joint.upper == pytest.approx(np.arctan2(back, reach), abs=0.05)
    assert found.joint.axis[2] > 0
    (patch,) = found.contacts
    assert patch.gap_m < 0.01
    assert np.linalg.norm(patch.normal) == pytest.approx(1.0)
    assert found.axis_sd_rad == found.origin_sd_m == found.type_margin == 0.0
    assert not np.any(found.theta_sd)


def test_printed_signs_put_the_hinge_under_the_hand(demonstration: MotionInput) -> None:
    found = estimate_motion_paper(demonstration, sliding_masks(), "revolute")
    assert found.joint.origin[1] == pytest.approx(found.contacts[0].point[1], abs=0.06)


def test_half_a_film_of_motion_is_refused_as_printed_and_found_when_repaired(
    demonstration: MotionInput,
) -> None:
    masks = sliding_masks(50, 150)
    curves: list[MotionCurve] = []
    with pytest.raises(NoMotionError, match="threshold"):
        estimate_motion_paper(demonstration, masks, "revolute", on_curve=curves.append)
    assert curves[0].smoothed.max() < curves[0].threshold
    found = estimate_motion_paper(demonstration, masks, "revolute", "threshold")
    assert [found.start_s, found.end_s] == pytest.approx([TIMES_S[50], TIMES_S[150]], abs=0.25)


def test_masks_of_another_film_are_refused(demonstration: MotionInput) -> None:
    short = PartMasks(moving=np.zeros((5, 8, 8), bool), robot=np.zeros((5, 8, 8), bool))
    with pytest.raises(InputError, match="5 frames, the video has 200"):
        estimate_motion_paper(demonstration, short, "revolute")


def test_the_nearest_pair_is_carried_by_its_link(demonstration: MotionInput, robot: RobotModel) -> None:
    """A point 3 mm off one fingertip; later it lies where the finger takes it."""
    log = drawing_log(robot)
    pad = robot.pads[0]
    before, after = OFFSET_S + TIMES_S[FIRST], OFFSET_S + TIMES_S[LAST]
    body = robot.link_poses(*log.at([before]))[0, pad.body]
    tip = apply(body, pad.face_body)
    far = tip + np.array([[0.003, 0, 0], [0, 0, 0.5]])
    pair = nearest_pair(robot, log, far, before, np.random.default_rng(0))
    assert pair.on_part == pytest.approx(far[0])
    assert pair.gap_m < 0.006
    assert apply(robot.link_poses(*log.at([before]))[0, pair.body], pair.point_body) == pytest.approx(
        pair.on_robot
    )
    path = contact_path(pair, robot, log, np.array([before, after]))
    poses = robot.link_poses(*log.at([before, after]))[:, pair.body]
    assert invert(poses[1]) @ np.append(path[1], 1) == pytest.approx(np.append(pair.point_body, 1))
    assert path[0] == pytest.approx(pair.on_robot)


def test_what_changed_beside_the_part_is_the_part_and_its_shadow_is_not() -> None:
    """A bright square slides to the right by 6 px over a textured ground and darkens what is below it."""
    rng = np.random.default_rng(0)
    ground = rng.uniform(60, 120, (48, 64, 3)) * [1.0, 0.8, 0.5]
    frames = np.tile(ground, (12, 1, 1, 1))
    true = np.zeros((12, 48, 64), bool)
    for k in range(12):
        right = max(0, k - 5)
        true[k, 10:30, 12 + right : 32 + right] = True
        frames[k, 30:36, 12 + right : 32 + right] *= 0.7 if k > 5 else 1.0
        frames[k][true[k]] = [40, 60, 230]
    frames += rng.normal(0, 1.0, frames.shape)
    robot = np.zeros_like(true)
    robot[:, :12, :20] = True
    found = change_masks(np.clip(frames, 0, 255).astype(np.uint8), robot, true[0], 4)
    assert not np.any(found & robot)
    shadow = found[-1, 31:36].mean()
    assert shadow < 0.05
    beside = true[-1] & ~true[0]
    assert found[-1][beside].mean() > 0.9
