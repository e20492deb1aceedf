"""Rigid ICP and link boxes do what the paper says, and no more: a rigid motion leaves a wrong size wrong."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.pose_search import Scan
from aomgen.alignment.starting_poses import RobotBox
from aomgen.core.camera import Camera, camera_in_world, look_at
from aomgen.core.gaussians import Gaussians, gaussians_of
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, similarity, similarity_parts, transform
from aomgen.errors import AlignmentError
from aomgen.paper import icp_alignment as paper_alignment
from aomgen.paper.icp_alignment import (
    align_as_paper,
    fit_weighted_rigid,
    measure_match,
    rigid_icp,
    robot_points,
)
from aomgen.paper.methods import bodies_in_boxes
from aomgen.robots.robot import RobotConfiguration, RobotModel

S_WORLD_RECON = similarity(0.37, matrix_from_rotvec([1.1, -0.7, 2.0]), [0.4, -0.2, 0.9])
S_RECON_WORLD = np.array(np.linalg.inv(S_WORLD_RECON), np.float64)
OFF = transform(matrix_from_rotvec([0.05, -0.04, 0.12]), [0.03, -0.02, 0.02])


@pytest.fixture(scope="module")
def configuration(robot: RobotModel) -> RobotConfiguration:
    joints = np.array([3.5, -2.2, 2.4, 0.25, 1.35, 0.0])
    return RobotConfiguration(robot=robot, joints=joints, gripper=0.1)


@pytest.fixture(scope="module")
def model(configuration: RobotConfiguration) -> np.ndarray:
    return configuration.surface_world(8_000, np.random.default_rng(0))


def cameras_recon() -> list[Camera]:
    cameras = []
    for angle in (0.3, 1.9, 3.1):
        eye = [-0.2 + 1.9 * np.cos(angle), 1.9 * np.sin(angle), 0.8]
        pose = look_at(eye, [-0.2, 0.0, 0.35])
        world = Camera(fx=260.0, fy=260.0, cx=160.0, cy=120.0, width=320, height=240, T_world_cam=pose)
        cameras.append(camera_in_world(S_RECON_WORLD, world))
    return cameras


def views() -> list[AlignmentImage]:
    image = np.zeros((240, 320, 3), np.uint8)
    return [
        AlignmentImage(name=f"{k}", camera_recon=c, image_srgb=image) for k, c in enumerate(cameras_recon())
    ]


def boxes(configuration: RobotConfiguration) -> list[RobotBox]:
    robot = apply(S_RECON_WORLD, configuration.points_world())
    found = []
    for camera in cameras_recon()[:2]:
        pixels = camera.project(robot)[0]
        found.append(RobotBox(camera_recon=camera, box_px=np.concatenate([pixels.min(0), pixels.max(0)])))
    return found


def scan(robot_world: np.ndarray) -> Gaussians:
    """Robot surface on a table, recon frame."""
    rng = np.random.default_rng(1)
    table = np.concatenate([rng.uniform(-1.2, 1.0, (30_000, 2)), rng.normal(0, 0.002, (30_000, 1))], 1)
    means = apply(S_RECON_WORLD, np.concatenate([robot_world, table]))
    count = len(means)
    return gaussians_of(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        scales=np.full((count, 3), 0.01),
        opacities=np.full(count, 0.9),
        sh=np.zeros((count, 1, 3)),
    )


def near_right(monkeypatch: pytest.MonkeyPatch, scale: float = 1.0) -> None:
    """Starts some centimetres, seven degrees and a size off, before the scan's unit frame is left."""

    def starts(scan: Scan, *_: object) -> np.ndarray:
        S_unit_recon = camera_frame(scan.views)
        size = similarity(scale, np.eye(3), [0.0, 0.0, 0.0])
        return (size @ OFF @ S_WORLD_RECON @ np.linalg.inv(S_unit_recon))[None]

    def camera_frame(views_unit: list[AlignmentImage]) -> np.ndarray:
        T_unit, T_recon = (item.camera_recon.T_world_cam for item in (views_unit[0], views()[0]))
        centers = [np.array([v.camera_recon.center for v in item]) for item in (views_unit, views())]
        sizes = [np.linalg.norm(c[0] - c[1]) for c in centers]
        ratio = sizes[0] / sizes[1]
        R = T_unit[:3, :3] @ T_recon[:3, :3].T
        return similarity(ratio, R, centers[0][0] - ratio * R @ centers[1][0])

    monkeypatch.setattr(paper_alignment, "_starts", starts)


def test_icp_finds_a_hidden_motion_among_strays(model: np.ndarray) -> None:
    rng = np.random.default_rng(2)
    strays = rng.uniform(-1.5, 1.5, (300, 3))
    source = apply(invert(OFF), np.concatenate([model[::8] + rng.normal(0, 0.001, model[::8].shape), strays]))
    found = rigid_icp(source, model, 0.01)
    assert found @ invert(OFF) == pytest.approx(np.eye(4), abs=2e-3)
    matched, rms_m = measure_match(apply(found, source), model, 0.01)
    assert 0.7 < matched < 0.85
    assert rms_m < 0.008


def test_the_answer_moves_with_the_clouds(model: np.ndarray) -> None:
    source = apply(invert(OFF), model[::10])
    T = transform(matrix_from_rotvec([0.4, 1.0, -0.3]), [0.3, 0.1, -2.0])
    plain = rigid_icp(source, model, 0.01)
    carried = rigid_icp(apply(T, source), apply(T, model), 0.01)
    assert carried == pytest.approx(T @ plain @ invert(T), abs=1e-4)


def test_points_without_weight_stay() -> None:
    points = np.random.default_rng(3).normal(size=(5, 3))
    assert np.array_equal(fit_weighted_rigid(points, points + 1, np.zeros(5)), np.eye(4))
    assert fit_weighted_rigid(points, points + 1, np.ones(5)) == pytest.approx(
        transform(np.eye(3), [1, 1, 1])
    )


def test_mirrored_points_are_not_mirrored() -> None:
    points = np.random.default_rng(4).normal(size=(20, 3))
    T = fit_weighted_rigid(points, points * [1, 1, -1], np.ones(20))
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_a_scan_of_the_right_size_is_aligned(configuration, model, monkeypatch) -> None:
    near_right(monkeypatch)
    found = align_as_paper(
        views(), boxes(configuration), scan(model[::3]), configuration, np.random.default_rng(0)
    )
    moved = apply(found.S_world_recon @ S_RECON_WORLD, configuration.ee_world)
    assert np.linalg.norm(moved - configuration.ee_world) < 0.005
    assert found.support > 0.8
    assert 0 < found.ee_sd_m < 0.01


def test_a_wrong_size_stays_wrong(configuration, model, monkeypatch) -> None:
    near_right(monkeypatch, scale=1.06)
    found = align_as_paper(
        views(), boxes(configuration), scan(model[::3]), configuration, np.random.default_rng(0)
    )
    assert similarity_parts(found.S_world_recon)[0] == pytest.approx(1.06 * 0.37, rel=1e-6)


def test_the_table_is_not_robot(configuration, model, monkeypatch) -> None:
    surface = np.asarray(scan(model[::3]).means, np.float64)
    up = S_RECON_WORLD[:3, 2] / np.linalg.norm(S_RECON_WORLD[:3, 2])
    points = robot_points(surface, boxes(configuration), up, np.random.default_rng(0))
    monkeypatch.setattr(paper_alignment, "_without_support", lambda points, *_: points)
    everything = robot_points(surface, boxes(configuration), up, np.random.default_rng(0))
    low, low_of_all = (np.mean(apply(S_WORLD_RECON, found)[:, 2] < 0.01) for found in (points, everything))
    assert low < 0.06
    assert low < 0.4 * low_of_all
    assert len(points) > 500


def test_refusals_say_why(configuration, model, monkeypatch) -> None:
    near_right(monkeypatch)
    rng, scene = np.random.default_rng(0), scan(model[::3])
    with pytest.raises(AlignmentError, match="1 prompts give a box"):
        align_as_paper(views(), boxes(configuration)[:1], scene, configuration, rng)
    faint = replace(scene, opacities=np.full(len(scene), 0.1, np.float32))
    with pytest.raises(AlignmentError, match="lie in all robot boxes"):
        align_as_paper(views(), boxes(configuration), faint, configuration, rng)
    elsewhere = scan(np.random.default_rng(5).uniform([-0.9, -0.5, 0.1], [0.3, 0.5, 0.9], (4000, 3)))
    with pytest.raises(AlignmentError, match="lie on the model"):
        align_as_paper(views(), boxes(configuration), elsewhere, configuration, rng, min_matched=0.6)


def test_link_boxes_hold_their_links_and_nothing_far(configuration) -> None:
    poses = configuration.robot.link_poses(configuration.joints[None], configuration.gripper)[0]
    points = np.concatenate([apply(poses[m.body], m.vertices_body[::20]) for m in configuration.robot.meshes])
    owners = np.concatenate([np.full(len(m.vertices_body[::20]), m.body) for m in configuration.robot.meshes])
    found = bodies_in_boxes(points, configuration)
    assert np.all(found >= 0)
    assert np.mean(found == owners) > 0.7
    assert np.all(bodies_in_boxes(points + [0, 0, 3.0], configuration) == -1)
    # What stands in a box is taken as robot, also in front of the surface.
    corner = poses[configuration.robot.meshes[0].body]
    vertices = np.concatenate(
        [m.vertices_body for m in configuration.robot.meshes if m.body == configuration.robot.meshes[0].body]
    )
    assert bodies_in_boxes(apply(corner, vertices.max(0)[None]), configuration)[0] >= 0


def test_link_boxes_move_with_the_robot(configuration) -> None:
    turned = replace(configuration, joints=configuration.joints + [0.7, 0, 0, 0, 0, 0])
    points = configuration.points_world(400)
    T = transform(matrix_from_rotvec([0, 0, 0.7]), [0, 0, 0])
    before, after = bodies_in_boxes(points, configuration), bodies_in_boxes(apply(T, points), turned)
    upper = before > 1
    assert np.mean(before[upper] == after[upper]) > 0.99
