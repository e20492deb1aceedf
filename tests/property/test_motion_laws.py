"""Laws of the whole AOMotion: where the world stands does not matter, and time turned back closes what opened."""

import copy
from dataclasses import replace
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares

from aomgen.conventions import MOVING
from aomgen.core.alignment import Clock
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import concatenate
from aomgen.core.joint import Joint, JointType
from aomgen.core.motion import MotionEstimate
from aomgen.core.recording import JointLog
from aomgen.core.transforms import (
    angle_between,
    apply,
    invert,
    matrix_from_quat,
    matrix_from_rotvec,
    quat_from_matrix,
    rotvec_from_matrix,
    transform,
)
from aomgen.core.values import Array
from aomgen.errors import AmbiguousJointError, DemonstrationTooShortError, NoMotionError
from aomgen.io.video import Video
from aomgen.motion import contact, joint_trajectory
from aomgen.motion.estimate import MotionParams, estimate_motion
from aomgen.motion.inputs import MotionInput
from aomgen.motion.joint_estimation import JointParams
from aomgen.motion.joint_trajectory import WINDOW_S, TouchRecovery
from aomgen.motion.observations import VideoObservations
from aomgen.motion.part_renderer import Band
from aomgen.motion.photometric import PhotometricParams
from aomgen.robots.loading import load_robot
from aomgen.robots.robot import RobotModel
from aomgen.robots.silhouette import robot_masks
from aomgen.splatting.rasterizer import RigidParts, render
from aomgen.splatting.session import RenderSession
from patterned_box import FACE, HANDLE, scene

FPS, LENGTH_S = 10.0, 5.0
FRAMES_S = np.arange(round(FPS * LENGTH_S) + 1) / FPS
# Film times of the hand's coming, of the motion, and of its going; symmetric, so that the film backwards is alike.
NEAR_S, MOTION_S, GRIP_S = (1.0, 4.0), (1.5, 3.5), (1.0, 1.2, 3.8, 4.0)
# The hand's directions at the handle: closing across the bar, out of the palm.
R_WORLD_HAND = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
SEED_JOINTS = np.array([3.9, -1.8, 2.2, -0.4, 2.0, 0.0])
# Fewer nodes, frames and pixels than usual, so that the tests are quick.
QUICK = MotionParams(
    width=120,
    joint=JointParams(nodes=8),
    contact_steps=2,
    photometric=PhotometricParams(knots=3, max_pixels=4000, bands=(Band(blur_px=1.0, wide_px=4.0),)),
)
HINGE = Joint(
    type="revolute",
    axis=np.array([0, 0, 1.0]),
    origin=np.array([0.72, FACE, 0.35]),
    lower=0.0,
    upper=float(np.radians(40)),
)
SLIDE = Joint(type="prismatic", axis=np.array([0, -1.0, 0]), origin=HANDLE, lower=0.0, upper=0.14)
JOINTS = {"door": HINGE, "drawer": SLIDE}
both = pytest.mark.parametrize("kind", JOINTS)
# Values are compared in these units: a tenth of a degree of a door, 0.3 mm of a drawer.
UNIT = {"door": float(np.radians(0.1)), "drawer": 3e-4}


def solved(robot: RobotModel, Ts_world_ee: Array, first: Array) -> Array:
    """Joints (T, 6) that bring the hand to poses (T, 4, 4), each looked for from the one before."""

    def misfit(joints: Array, T: Array) -> Array:
        reached = robot.ee_poses(joints[None])[0]
        return np.concatenate(
            [reached[:3, 3] - T[:3, 3], 0.3 * rotvec_from_matrix(reached[:3, :3].T @ T[:3, :3])]
        )

    rows = []
    for T in Ts_world_ee:
        found = least_squares(misfit, first, args=(T,), xtol=1e-12, ftol=1e-12)
        assert found.cost < 1e-10
        first = found.x
        rows.append(first)
    return np.array(rows)


def thetas_at(joint: Joint, times_s: Array) -> Array:
    """Opened as far (T,) at film times (T,), [rad] or [m]."""
    u = np.clip((times_s - MOTION_S[0]) / (MOTION_S[1] - MOTION_S[0]), 0, 1)
    return joint.upper * u**3 * (10 - 15 * u + 6 * u**2)


@cache
def world(kind: str) -> MotionInput:
    """A hand that comes, holds the handle, opens the door or pulls it out as a drawer's front, and goes."""
    joint = JOINTS[kind]
    robot = load_robot("ur5e_2f85")
    times = np.linspace(0, LENGTH_S, 51)
    T_first = transform(R_WORLD_HAND, HANDLE)
    held = joint.motion(thetas_at(joint, times)) @ T_first
    off = 0.1 * np.interp(times, [0, NEAR_S[0], NEAR_S[1], LENGTH_S], [1, 0, 0, 1])
    held[:, :3, 3] -= off[:, None] * held[:, :3, 2]
    log = JointLog(
        times_s=times,
        joints=solved(robot, held, SEED_JOINTS),
        gripper=np.interp(times, GRIP_S, [0.0, 0.85, 0.85, 0.0]),
        joint_names=robot.joint_names,
    )
    gaussians, labels = scene()
    camera = Camera(
        fx=150.0, fy=150.0, cx=80.0, cy=60.0, width=160, height=120,
        T_world_cam=look_at([0.95, -0.45, 0.75], [0.57, 0.25, 0.33]),
    )  # fmt: skip
    session = RenderSession(gaussians.select(labels != MOVING), camera)
    moving = gaussians.select(labels == MOVING)
    parts = np.zeros(len(moving), np.int32)
    frames = np.stack(
        [
            session.draw(moving, RigidParts(indices=parts, Ts_world_part=joint.motion(theta)[None])).rgb
            for theta in thetas_at(joint, FRAMES_S)
        ]
    )
    with robot_masks(robot, camera, log) as masks_at:
        frames[masks_at(FRAMES_S, camera.width, camera.height)] = 0.3
    frames = frames + np.random.default_rng(0).normal(0, 0.006, frames.shape)
    return MotionInput(
        video=Video(frames_srgb=np.clip(255 * frames, 0, 255).astype(np.uint8), times_s=FRAMES_S, fps=FPS),
        camera=camera,
        log=log,
        robot=robot,
        scene=gaussians,
        labels=labels,
        clock=Clock(offset_s=0.0, sd_s=0.005),
    )


@cache
def opened(kind: str) -> MotionEstimate:
    return estimate_motion(world(kind), QUICK)


def locked(demo: MotionInput) -> MotionInput:
    """The same hand and log before a part that stays shut, while the arm's shadow passes over it."""
    still = np.repeat(render(demo.scene, demo.camera).rgb[None], len(FRAMES_S), 0)
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        masks = masks_at(FRAMES_S, demo.camera.width, demo.camera.height)
    still[np.roll(masks, (-25, 25), axis=(1, 2))] *= 0.4
    still[masks] = 0.3
    return replace(demo, video=replace(demo.video, frames_srgb=np.clip(255 * still, 0, 255).astype(np.uint8)))


def moved_robot(robot: RobotModel, T: Array) -> RobotModel:
    """The robot with its base at another place of the world."""

    def moved(pos: Array, quat: Array) -> tuple[Array, Array]:
        T_world_base = T @ transform(matrix_from_quat(quat), pos)
        return T_world_base[:3, 3], quat_from_matrix(T_world_base[:3, :3])

    def placed(spec: mujoco.MjSpec) -> mujoco.MjSpec:
        for body in spec.worldbody.bodies:
            body.pos, body.quat = moved(body.pos, body.quat)
        return spec

    model = copy.copy(robot._model)
    for k in range(1, model.nbody):
        if model.body_parentid[k] == 0:
            model.body_pos[k], model.body_quat[k] = moved(model.body_pos[k].copy(), model.body_quat[k].copy())
    return replace(robot, _model=model, _full=placed(robot.spec()), _bare=placed(robot.spec(visual=False)))


def elsewhere(demo: MotionInput, T: Array) -> MotionInput:
    """The whole world moved; film and log stay."""
    return replace(
        demo,
        camera=replace(demo.camera, T_world_cam=T @ demo.camera.T_world_cam),
        robot=moved_robot(demo.robot, T),
        scene=demo.scene.transform(T),
    )


def backwards(demo: MotionInput, joint: Joint) -> MotionInput:
    """Film, log and gripper backwards, and the scene as it would be scanned before that."""
    log, film, moving = demo.log, demo.video, demo.labels == MOVING
    gone = demo.scene.select(moving).transform(joint.motion(joint.upper))
    return replace(
        demo,
        video=replace(film, frames_srgb=film.frames_srgb[::-1]),
        log=replace(log, joints=log.joints[::-1], gripper=log.gripper[::-1]),
        scene=concatenate([gone, demo.scene.select(~moving)]),
        labels=np.concatenate([demo.labels[moving], demo.labels[~moving]]),
    )


def line_gap_m(first: Joint, second: Joint) -> float:
    """Distance of one axis' origin from the other axis, [m]; 0 for drawers, whose axes have no place."""
    offset = second.origin - first.origin
    across = offset - (offset @ first.axis) * first.axis
    return float(np.linalg.norm(across)) if first.type == "revolute" else 0.0


@both
def test_the_joint_is_found(kind: str) -> None:
    found, joint = opened(kind), JOINTS[kind]
    assert (found.joint.type, found.direction) == (joint.type, "opening")
    assert angle_between(found.joint.axis, joint.axis) < np.radians(0.5)
    assert line_gap_m(joint, found.joint) < 0.004
    assert found.thetas == pytest.approx(thetas_at(joint, FRAMES_S), abs=7 * UNIT[kind])


def test_contacts_are_where_the_hand_is_when_the_answered_motion_begins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first round may read the hand's way about a poor joint, and find another beginning."""
    grasps_ee = []

    def find(*args: Any) -> contact.Contacts:
        patches, grasp_ee = contact.find_contacts(*args)
        grasps_ee.append(grasp_ee)
        return patches, grasp_ee

    monkeypatch.setattr(joint_trajectory, "find_contacts", find)
    demo = world("drawer")
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        view = VideoObservations.of(demo, masks_at, QUICK.width)
    recovery = TouchRecovery.of(demo, view, QUICK.joint, QUICK.contact_steps)
    first = recovery.first_candidates()
    guess = first.prismatic
    axis = matrix_from_rotvec([0, 0, np.radians(80)]) @ guess.joint.axis
    poor = replace(first, prismatic=replace(guess, joint=replace(guess.joint, axis=axis)))
    _, found = recovery.recover(poor, "prismatic")
    hand = demo.ee_poses_at(found.start_s + np.linspace(0, WINDOW_S, QUICK.contact_steps))
    touch = np.mean([patch.point for patch in found.contacts], axis=0)
    assert touch == pytest.approx(apply(hand, grasps_ee[-1]).mean(0), abs=1e-4)


@pytest.mark.parametrize(("kind", "lean"), [("door", (0.1, -0.15)), ("drawer", (0.0, 0.0))])
def test_where_the_world_stands_changes_nothing(kind: str, lean: tuple[float, float]) -> None:
    T = transform(matrix_from_rotvec([*lean, 2.0]), np.array([0.7, -0.4, 0.3]))
    here, there = opened(kind), estimate_motion(elsewhere(world(kind), T), QUICK)
    seen_here = there.joint.move(invert(T))
    assert (there.joint.type, there.direction) == (here.joint.type, here.direction)
    assert angle_between(seen_here.axis, here.joint.axis) < np.radians(0.05)
    assert (there.start_s, there.end_s) == (here.start_s, here.end_s)
    # "Up" is the only direction that the world has: leaning, a part's box is found in another way, and with
    # it which side of a bar is flat against the fingers.
    upright = lean == (0.0, 0.0)
    assert line_gap_m(here.joint, seen_here) < (3e-4 if upright else 1e-3)
    assert there.thetas == pytest.approx(here.thetas, abs=(0.5 if upright else 1.5) * UNIT[kind])
    for mine, moved in zip(here.contacts, there.contacts, strict=True):
        assert apply(invert(T), moved.point) == pytest.approx(mine.point, abs=1e-3 if upright else 1e-2)


@both
def test_time_turned_back_closes_what_was_opened(kind: str) -> None:
    forth, back = opened(kind), estimate_motion(backwards(world(kind), JOINTS[kind]), QUICK)
    assert back.joint.type == forth.joint.type
    assert (forth.direction, back.direction) == ("opening", "closing")
    assert angle_between(back.joint.axis, -forth.joint.axis) < np.radians(0.3)
    assert line_gap_m(forth.joint, back.joint) < 2e-3
    assert back.thetas == pytest.approx(forth.thetas[-1] - forth.thetas[::-1], abs=5 * UNIT[kind])
    assert back.start_s == pytest.approx(LENGTH_S - forth.end_s, abs=0.11)
    assert back.end_s == pytest.approx(LENGTH_S - forth.start_s, abs=0.11)


def drop_drawers(monkeypatch: pytest.MonkeyPatch, **changes: float) -> None:
    """Let no motion remain for a drawer, and change the candidates that are found for a door."""
    recover = TouchRecovery.recover

    def recover_doors_only(self: TouchRecovery, found: Any, joint_type: JointType, *rest: Any) -> Any:
        if joint_type == "prismatic":
            raise DemonstrationTooShortError("joint", "the gripper moved the part 4 mm", "record more")
        candidates, estimate = recover(self, found, joint_type, *rest)
        return replace(candidates, **changes), estimate

    monkeypatch.setattr(TouchRecovery, "recover", recover_doors_only)


def test_a_rival_type_without_any_motion_does_not_refuse_the_demonstration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A gripper that was hardly open pushes, as far as its log shows; read as a drawer's, its motion is too short."""
    drop_drawers(monkeypatch)
    found = estimate_motion(world("door"), QUICK)
    assert found.joint.type == "revolute"
    assert found.thetas == pytest.approx(opened("door").thetas, abs=UNIT["door"])
    with pytest.raises(DemonstrationTooShortError):
        estimate_motion(world("drawer"), QUICK)


def test_a_remaining_type_must_be_decided_by_the_path(monkeypatch: pytest.MonkeyPatch) -> None:
    drop_drawers(monkeypatch, margin=1.0)
    with pytest.raises(AmbiguousJointError):
        estimate_motion(world("door"), QUICK)
    monkeypatch.undo()
    drop_drawers(monkeypatch, margin=-400.0, unseen_bulge_m=0.0)
    with pytest.raises(DemonstrationTooShortError, match="moved the part 4"):
        estimate_motion(world("door"), QUICK)


def test_a_locked_part_under_the_arms_shadow_is_refused() -> None:
    """The shadow changes the part while the gripper moves, which alone looks like a motion."""
    demo = locked(world("door"))
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        VideoObservations.of(demo, masks_at, QUICK.width).weigh_motion(demo).check()
    with pytest.raises(NoMotionError, match="fits a part at rest better"):
        estimate_motion(demo, QUICK)
