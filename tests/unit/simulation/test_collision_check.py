"""Nothing slips through between the samples of a trajectory."""

from itertools import pairwise, product

import mujoco
import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.core.boxes import OrientedBox
from aomgen.core.plan import Rejection
from aomgen.core.transforms import apply, transform
from aomgen.episodes.ik import ik_solver
from aomgen.robots.robot import RobotModel
from aomgen.simulation import collision_check
from aomgen.simulation.collision_check import (
    SWEEP_M,
    KinematicLimits,
    check_kinematics,
    make_collision_test,
    self_overlap_mm,
)
from aomgen.simulation.scene import Scene, build_scene
from toy_drawer import NEAR, SUPPORT, fitted_drawer, opening

# Behind the robot, so that the arm moves freely.
FAR = transform(np.eye(3), [-1.5, -1.5, SUPPORT.height])
LIMITS = KinematicLimits()
JOINTS_A_SAMPLE = 0.26


def scene_with(robot: RobotModel, *obstacles: OrientedBox) -> Scene:
    return build_scene(robot, make_asset("drawer", 1), FAR, SUPPORT, obstacles=obstacles)


def check(scene: Scene, joints: np.ndarray, thetas: np.ndarray) -> dict[str, float] | Rejection:
    count = len(joints)
    return check_kinematics(scene, joints, np.zeros(count), thetas, np.zeros(count, bool), LIMITS)


def test_no_point_moves_far_between_two_looks(robot: RobotModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the largest speed of all joints, for points of every mesh of the robot and for the part's corners."""
    scene, looks = scene_with(robot), []
    place = collision_check.place_scene

    def recorded(scene: Scene, data, qpos: np.ndarray) -> None:
        looks.append(qpos.copy())
        place(scene, data, qpos)

    monkeypatch.setattr(collision_check, "place_scene", recorded)
    rng = np.random.default_rng(0)
    corners = np.concatenate([box.corners for box in scene.asset.moving.colliders])
    for _ in range(12):
        joints = NEAR + np.cumsum(rng.uniform(-1, 1, (4, 6)) * JOINTS_A_SAMPLE, axis=0)
        thetas = np.cumsum(rng.uniform(0, 0.06, 4))
        looks.clear()
        if isinstance(check(scene, joints, thetas), Rejection):
            continue
        shares = np.array(looks)[:, scene.arm.qpos]
        # In order along the trajectory, which is straight between its samples.
        states = np.unique(np.round(np.array(looks)[1:], 12), axis=0)
        ordered = []
        for a, b in pairwise(np.column_stack([joints, thetas])):
            known = np.column_stack([states[:, scene.arm.qpos], states[:, scene.object_qpos]])
            along = (known - a) @ (b - a) / ((b - a) @ (b - a))
            on = np.abs(known - a - along[:, None] * (b - a)).max(1) < 1e-9
            inside = on & (along > -1e-9) & (along < 1 + 1e-9)
            ordered.append(known[inside][np.argsort(along[inside])])
        for rows in ordered:
            poses = robot.link_poses(rows[:, :6], 0.0)
            for mesh in robot.meshes:
                points = apply(poses[:, None, mesh.body], mesh.vertices_body[None, ::40])
                assert np.linalg.norm(np.diff(points, axis=0), axis=-1).max(initial=0) <= SWEEP_M
            moved = apply(scene.asset.joint.motion(rows[:, 6])[:, None], corners[None])
            assert np.linalg.norm(np.diff(moved, axis=0), axis=-1).max(initial=0) <= SWEEP_M
        assert len(shares) > 4


def test_a_thin_wall_between_two_samples_is_met(robot: RobotModel) -> None:
    joints = np.array([NEAR, NEAR + [0.26, 0, 0, 0, 0, 0]])
    hand = robot.ee_poses(joints.mean(0)[None])[0, :3, 3]
    beside = robot.ee_poses(joints)[:, :3, 3]
    across = (beside[1] - beside[0]) / np.linalg.norm(beside[1] - beside[0])
    R = np.stack([across, np.cross([0, 0, 1.0], across), [0, 0, 1.0]], 1)
    wall = OrientedBox(T_world_box=transform(R, hand), half_extents=np.array([0.001, 0.03, 0.06]))
    still = np.zeros(2)
    free, met = scene_with(robot), scene_with(robot, wall)
    assert isinstance(check(free, joints, still), dict)
    for end in joints:
        assert isinstance(check(met, np.array([end, end]), still), dict), "free at both samples"
    result = check(met, joints, still)
    assert isinstance(result, Rejection)
    assert result.reason == "collision"
    assert 0 < result.metrics["sample"] < 1
    assert "obstacles" in result.bodies[1]
    assert " and ".join(result.bodies) in result.detail
    assert result.excess == pytest.approx(
        result.metrics["penetration_mm"] / LIMITS.max_penetration_mm - 1, abs=1e-9
    )


def test_the_arm_keeps_clear_of_the_object_by_as_much_as_is_asked(robot: RobotModel) -> None:
    """An object is let down on the arm until it is met: MuJoCo's own distance is then what was asked."""
    clearance = 0.02
    scene, joints, still = scene_with(robot), np.array([NEAR, NEAR]), np.zeros(2)
    elbow = robot.link_poses(NEAR[None], 0.0)[0, robot.body_names.index("forearm_link"), :3, 3]
    met, free = elbow[2], elbow[2] + 0.5
    while free - met > 1e-4:
        middle = 0.5 * (met + free)
        near = scene.place_at(transform(np.eye(3), [elbow[0], elbow[1], middle]), clearance)
        met, free = (middle, free) if isinstance(check(near, joints, still), Rejection) else (met, middle)
    data, roles = mujoco.MjData(near.model), near.roles
    data.qpos[:] = near.qpos(NEAR[None], 0.0, 0.0)[0]
    mujoco.mj_kinematics(near.model, data)
    pairs = product(np.flatnonzero(roles.robot & ~roles.gripper), np.flatnonzero(roles.object))
    distance = min(mujoco.mj_geomDistance(near.model, data, int(a), int(b), 0.1, None) for a, b in pairs)
    assert distance == pytest.approx(clearance - LIMITS.max_penetration_mm / 1000, abs=3e-4)


def test_an_arm_that_begins_in_itself_collides_unless_a_real_one_stood_there(robot: RobotModel) -> None:
    folded = np.array([0.33, -0.73, 1.49, 1.42, 2.72, 2.22])
    scene, joints, still = scene_with(robot), np.array([folded, folded]), np.zeros(2)
    overlap = self_overlap_mm(scene, folded, 0.0)
    assert overlap > 5
    result = check(scene, joints, still)
    assert isinstance(result, Rejection)
    assert result.reason == "self_collision"
    real = KinematicLimits(max_self_penetration_mm=1 + overlap)
    assert isinstance(check_kinematics(scene, joints, still, still, still > 0, real), dict)


def test_the_gripper_keeps_the_clearance_only_on_request(robot: RobotModel) -> None:
    """The gripper of a demonstrated approach comes closer to the object than the clearance, the arm does not."""
    fitted, clearance = fitted_drawer(), 0.05
    demo = opening(ik_solver(robot), fitted)
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    wide = scene.place_at(fitted.T_world_asset, clearance)
    usual, whole = (
        make_collision_test(wide, 0.0, 0.0, LIMITS, gripper_as_arm=kept) for kept in (False, True)
    )
    approach = demo.joints[: demo.contact_frames[0]]
    free, clear = (np.array([test(joints) for joints in approach]) for test in (usual, whole))
    assert free.all()
    assert clear[0]
    assert not clear[-1]
    assert np.all(np.diff(clear.astype(int)) <= 0)


def test_the_gripper_keeps_its_own_clearance_from_the_static_link(robot: RobotModel) -> None:
    """The gripper that holds the handle is near the closed drawer's body, and far from it when the drawer is open."""
    fitted, clearance = fitted_drawer(), 0.06
    demo = opening(ik_solver(robot), fitted)
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    first, last = demo.contact_frames[[0, -1]]

    def is_free(gripper_clearance: float, frame: int, theta: float) -> bool:
        near = scene.place_at(fitted.T_world_asset, 0.0, gripper_clearance)
        gripper = float(demo.gripper[frame])
        return make_collision_test(near, gripper, theta, LIMITS, holding=True)(demo.joints[frame])

    assert is_free(0.0, first, 0.0)
    assert not is_free(clearance, first, 0.0)
    assert fitted.target_theta > clearance
    assert is_free(clearance, last, fitted.target_theta)


def test_an_object_in_an_obstacle_collides(robot: RobotModel) -> None:
    joints, still = np.array([NEAR, NEAR]), np.zeros(2)
    box = OrientedBox(T_world_box=FAR, half_extents=np.full(3, 0.05))
    result = check(scene_with(robot, box), joints, still)
    assert isinstance(result, Rejection)
    assert result.reason == "collision"
    opened = make_asset("drawer", 1)
    ahead = apply(FAR @ opened.joint.motion(0.15), opened.handle_point)
    box = OrientedBox(T_world_box=transform(np.eye(3), ahead), half_extents=np.full(3, 0.01))
    assert isinstance(check(scene_with(robot, box), joints, still), dict)
    assert isinstance(check(scene_with(robot, box), joints, np.array([0.0, 0.15])), Rejection)
