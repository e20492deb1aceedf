"""Alignment finds a hidden similarity from drawn images, and refuses where no robot stands."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from aomgen.alignment.align import AlignmentParams, _refuse_wrong_joints, align
from aomgen.alignment.confidence import ViewEvidence, collect_evidence, find_wrist_rotation
from aomgen.alignment.contours import AlignmentImage, Contour, edge_shifts, region_shifts, shift_jacobian
from aomgen.alignment.pose_search import Scan
from aomgen.alignment.silhouette_fit import robot_drawing
from aomgen.alignment.starting_poses import RobotBox, up_candidates
from aomgen.alignment.uncertainty import joint_offsets
from aomgen.core.alignment import Alignment
from aomgen.core.camera import Camera, camera_in_world, look_at
from aomgen.core.progress import silent
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity, similarity_parts, transform
from aomgen.errors import AlignmentError
from aomgen.robots.robot import RobotConfiguration, RobotModel
from aomgen.robots.silhouette import SilhouetteRenderer

JOINTS = np.array([3.5, -2.2, 2.4, 0.25, 1.35, 0.0])
S_WORLD_RECON = similarity(0.37, matrix_from_rotvec([1.1, -0.7, 2.0]), [0.4, -0.2, 0.9])
HINGES = np.zeros(2, bool)
PARAMS = AlignmentParams(views=6, contour_points=250, start_poses=(600,), search_views=5, search_width=64)


@pytest.fixture(scope="module")
def configuration(robot: RobotModel) -> RobotConfiguration:
    return RobotConfiguration(robot=robot, joints=JOINTS, gripper=0.1)


def recon_camera(angle: float, height: float, focal_px: float = 260.0) -> Camera:
    eye = [-0.2 + 1.9 * np.cos(angle), 1.9 * np.sin(angle), height]
    world = Camera(
        fx=focal_px, fy=focal_px, cx=160.0, cy=120.0, width=320, height=240,
        T_world_cam=look_at(eye, [-0.2, 0.0, 0.35]),
    )  # fmt: skip
    return camera_in_world(np.array(np.linalg.inv(S_WORLD_RECON), np.float64), world)


def scene(
    configuration: RobotConfiguration, rng: np.random.Generator, *, robot: bool, focal_px: float = 260.0
) -> tuple[list[AlignmentImage], list[RobotBox]]:
    """Flat-colored robot bodies before a cloudy background, with sensor noise."""
    colors = rng.uniform(60, 220, (len(configuration.robot.body_names), 1)) + rng.normal(0, 15, (1, 3))
    views, boxes = [], []
    with SilhouetteRenderer(configuration.robot, max_width=320, max_height=240) as renderer:
        for index in range(6):
            camera = recon_camera(2 * np.pi * index / 8, 0.5 + 0.06 * index, focal_px)
            bodies, _ = renderer.draw(camera_in_world(S_WORLD_RECON, camera), JOINTS, 0.1)
            clouds = np.stack([gaussian_filter(rng.normal(0, 500, (240, 320)), 6) for _ in range(3)], -1)
            image = 120 + clouds
            if robot:
                image = np.where((bodies >= 0)[..., None], colors[bodies], image)
            image = (image + rng.normal(0, 3, image.shape)).clip(0, 255).astype(np.uint8)
            views.append(AlignmentImage(name=f"{index}", camera_recon=camera, image_srgb=image))
            if index in (1, 4):
                v, u = np.nonzero(bodies >= 0)
                box = np.array([u.min(), v.min(), u.max() + 1, v.max() + 1]) + rng.normal(0, 3, 4)
                boxes.append(RobotBox(camera_recon=camera, box_px=box))
    return views, boxes


def scan_of(views: list[AlignmentImage], boxes: list[RobotBox], points_recon: np.ndarray) -> Scan:
    return Scan(views=views, boxes=boxes, points_recon=points_recon)


def ground_points(rng: np.random.Generator) -> np.ndarray:
    floor = np.concatenate([rng.uniform(-2, 2, (400, 2)), rng.normal(0, 0.003, (400, 1))], 1)
    return apply(np.linalg.inv(S_WORLD_RECON), np.concatenate([floor, rng.uniform(-1, 1, (80, 3))]))


@pytest.fixture(scope="module")
def robot_scan(configuration: RobotConfiguration) -> Scan:
    rng = np.random.default_rng(3)
    return scan_of(*scene(configuration, rng, robot=True), ground_points(rng))


@pytest.fixture(scope="module")
def result(robot_scan: Scan, configuration: RobotConfiguration) -> Alignment:
    return align(robot_scan, configuration, silent, np.random.default_rng(0), PARAMS)


def test_a_hidden_similarity_is_found_to_millimetres(result, configuration):
    moved = apply(result.S_world_recon @ np.linalg.inv(S_WORLD_RECON), configuration.ee_world)
    assert np.linalg.norm(moved - configuration.ee_world) < 0.004
    assert similarity_parts(result.S_world_recon)[0] == pytest.approx(0.37, rel=0.005)
    assert result.ee_sd_m < 0.003


def test_images_without_the_robot_are_refused(configuration):
    rng = np.random.default_rng(4)
    views, boxes = scene(configuration, rng, robot=False)
    with pytest.raises(AlignmentError, match="confirm"):
        align(scan_of(views, boxes, ground_points(rng)), configuration, silent, rng, PARAMS)


@pytest.mark.parametrize("off_deg", [0.0, 60.0])
def test_a_wrist_turned_against_the_log_is_noticed(configuration, off_deg):
    views, _ = scene(configuration, np.random.default_rng(5), robot=True, focal_px=600.0)
    joints = JOINTS.copy()
    joints[-1] += np.radians(off_deg)
    with robot_drawing(replace(configuration, joints=joints), 320, 240) as drawing:
        logged = collect_evidence(S_WORLD_RECON, views, drawing, 400)
        found = find_wrist_rotation(S_WORLD_RECON, views, drawing, 400, logged)
    assert (found is not None) == (off_deg != 0)
    if found is not None:
        assert np.degrees(found[0]) == pytest.approx(-off_deg, abs=1e-6)


def test_no_box_is_refused(configuration):
    with pytest.raises(AlignmentError, match="robot box"):
        align(scan_of([], [], np.zeros((0, 3))), configuration, silent, np.random.default_rng(0))


def test_the_floor_gives_up_within_a_degree():
    rng = np.random.default_rng(5)
    cameras = [recon_camera(angle, 0.8) for angle in np.linspace(0, 3, 8)]
    up = up_candidates(cameras, ground_points(rng), rng)[0]
    expected = np.linalg.inv(S_WORLD_RECON[:3, :3]) @ [0, 0, 1.0]
    assert np.degrees(np.arccos(up @ expected / np.linalg.norm(expected))) < 1.0


def vertical_edge_contour(at: float, normal: float = 1.0) -> Contour:
    rows = np.arange(20.0, 80.0) + 0.5
    return Contour(
        pixels=np.stack([np.full(60, at), rows], 1),
        normals=np.tile([normal, 0.0], (60, 1)),
        points=np.zeros((60, 3)),
    )


@pytest.mark.parametrize("offset", [-5.0, 0.0, 3.0])
def test_region_and_edge_see_the_same_shift(offset):
    inside = np.where(np.arange(100) < 50, 1.0, -1.0)[None].repeat(100, 0).astype(np.float32)
    shifts, sds = region_shifts(vertical_edge_contour(50.0 - offset), inside, 10)
    assert shifts == pytest.approx(offset, abs=0.3)
    assert sds.max() < 1.9
    edges, strength = edge_shifts(vertical_edge_contour(50.0 - offset), (inside / 2).astype(np.float32), 8)
    assert edges == pytest.approx(offset, abs=0.5)
    assert strength.min() > 0.2


def test_jacobian_matches_finite_differences():
    rng = np.random.default_rng(6)
    camera = Camera(
        fx=300.0, fy=310.0, cx=150.0, cy=120.0, width=320, height=240,
        T_world_cam=look_at([2.0, 0.5, 1.0], [0, 0, 0]),
    )  # fmt: skip
    points, pivot = rng.uniform(-0.4, 0.4, (30, 3)), np.array([0.1, 0.2, -0.1])
    angles = rng.uniform(0, 6.28, 30)
    normals = np.stack([np.cos(angles), np.sin(angles)], 1)
    contour = Contour(pixels=camera.project(points)[0], normals=normals, points=points)
    J = shift_jacobian(camera, contour, pivot)
    for column in range(7):
        step = np.zeros(7)
        step[column] = 1e-6
        D = transform(matrix_from_rotvec(step[:3]) * np.exp(step[6]), pivot + step[3:6])
        moved = camera.project(apply(D, points - pivot))[0]
        numeric = np.einsum("cd,cd->c", moved - contour.pixels, normals) / 1e-6
        assert J[:, column] == pytest.approx(numeric, abs=1e-2)


def test_a_camera_keeps_its_pixels_through_the_similarity():
    camera = recon_camera(0.4, 0.9)
    points_recon = (camera.center + camera.directions()[100, 50] * 2)[None]
    before, _ = camera.project(points_recon)
    after, _ = camera_in_world(S_WORLD_RECON, camera).project(apply(S_WORLD_RECON, points_recon))
    assert after == pytest.approx(before, abs=1e-6)


def evidence_of(offsets_rad: np.ndarray, rng: np.random.Generator) -> list[ViewEvidence]:
    """Nine views of an outline whose two joints are off; the first turns what the whole robot may."""
    found = []
    for number in range(9):
        J = rng.normal(0, 100, (80, 7))
        joints = np.stack([J[:, 2] + rng.normal(0, 0.5, 80), rng.normal(0, 100, 80)], 1)
        shifts = joints @ offsets_rad + rng.normal(0, 0.3, 80)
        found.append(
            ViewEvidence(
                name=f"{number}",
                segments=np.ones(80, np.int64),
                confirmed=np.ones(80, bool),
                by_chance=np.zeros(80, bool),
                edge_px=shifts,
                edge_weights=np.ones(80),
                border_px=shifts,
                border_weights=np.ones(80),
                jacobian=J,
                joint_jacobian=joints,
                camera_jacobian=np.zeros((80, 6)),
                normals=np.tile([1.0, 0.0], (80, 1)),
            )
        )
    return found


def test_a_joint_that_is_off_is_measured():
    evidence = evidence_of(np.array([0.0, 0.1]), np.random.default_rng(8))
    offsets_rad, sds_rad, moves_px = joint_offsets(evidence, HINGES)
    assert offsets_rad[1] == pytest.approx(0.1, abs=0.003)
    assert sds_rad[1] < 0.003
    assert moves_px[1] == pytest.approx(10.0, rel=0.1)


@pytest.mark.parametrize(
    ("slides", "offset", "message"),
    [
        ([False, True], 0.008, r"b is \+8 mm from .* limit 5\)"),
        ([False, True], 0.003, ""),
        ([False, False], 0.1, r"b is \+6 deg from .* limit 2\)"),
        ([False, False], 0.03, ""),
    ],
)
def test_rails_have_a_limit_in_meters(slides, offset, message):
    pair = SimpleNamespace(joint_names=("a", "b"), slides=np.array(slides))
    evidence = evidence_of(np.array([0.0, offset]), np.random.default_rng(8))
    with pytest.raises(AlignmentError, match=message) if message else nullcontext():
        _refuse_wrong_joints(evidence, SimpleNamespace(robot=pair))


def test_a_last_joint_that_is_prismatic_has_no_rotation(configuration):
    rails = replace(configuration.robot, slides=np.arange(6) == 5)
    drawing = SimpleNamespace(configuration=replace(configuration, robot=rails))
    assert find_wrist_rotation(np.eye(4), [], drawing, 400, []) is None


def test_a_joint_that_only_turns_the_whole_robot_moves_next_to_nothing():
    _, _, moves_px = joint_offsets(evidence_of(np.array([0.3, 0.0]), np.random.default_rng(9)), HINGES)
    assert (moves_px < 0.3).all()


def test_the_answer_does_not_depend_on_scale_and_axes_of_the_structure(robot_scan, result, configuration):
    """The same scene in another frame: the robot comes to stand within a millimetre of the same place."""
    S = similarity(20.0, matrix_from_rotvec([2.0, 2.0, -1.5]), 20 * np.array([3.0, -1.0, 2.0]))
    scan = robot_scan.view_from(S)
    other = align(scan, configuration, silent, np.random.default_rng(0), PARAMS).S_world_recon @ S
    points = apply(np.linalg.inv(S_WORLD_RECON), configuration.points_world(50))
    assert np.linalg.norm(apply(result.S_world_recon, points) - apply(other, points), axis=1).max() < 0.001
