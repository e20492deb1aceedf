"""The alignment bench: what its starts do to a scene, which have an answer, and how it counts."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.starting_poses import RobotBox
from aomgen.core.camera import Camera, camera_in_world, look_at
from aomgen.core.transforms import matrix_from_rotvec, similarity, similarity_parts
from aomgen.robots.robot import RobotConfiguration, RobotModel
from aomgen.robots.silhouette import SilhouetteRenderer
from benchmarks.alignment import Outcome, summary
from benchmarks.alignment_cases import (
    UNSOLVABLE,
    Scene,
    make_case,
    mirrored,
    resimilated,
    without_robot,
)
from benchmarks.alignment_solvable import is_solvable

S_WORLD_RECON = similarity(0.6, matrix_from_rotvec([0.3, -0.5, 0.8]), [0.3, 0.1, -0.4])
JOINTS = np.array([3.5, -2.2, 2.4, 0.25, 1.35, 0.0])
ROBOT_SRGB, WALL_SRGB = 200, 40


@pytest.fixture(scope="module")
def scene(robot: RobotModel) -> Scene:
    """A bright robot before a dark wall, seen by twelve cameras, boxes on two of them."""
    configuration = RobotConfiguration(robot=robot, joints=JOINTS, gripper=0.1)
    views, boxes = [], []
    with SilhouetteRenderer(configuration.robot, max_width=120, max_height=90, cell_m=0.01) as renderer:
        for index in range(12):
            camera = recon_camera(0.25 * index)
            bodies, _ = renderer.draw(camera_in_world(S_WORLD_RECON, camera), JOINTS, 0.1)
            image = np.where((bodies >= 0)[..., None], ROBOT_SRGB, WALL_SRGB).astype(np.uint8).repeat(3, 2)
            views.append(AlignmentImage(name=f"{index}", camera_recon=camera, image_srgb=image))
            if index in (2, 8):
                v, u = np.nonzero(bodies >= 0)
                sides = np.array([u.min(), v.min(), u.max() + 1, v.max() + 1], np.float64)
                boxes.append(RobotBox(camera_recon=camera, box_px=sides))
    return Scene(
        name="drawn",
        views=views,
        robot_boxes=boxes,
        other_boxes=[replace(boxes[0], box_px=np.array([5.0, 5.0, 20.0, 20.0]))],
        points_recon=np.zeros((10, 3)),
        configuration=configuration,
        S_world_recon=S_WORLD_RECON,
    )


@pytest.fixture(scope="module")
def bare(scene: Scene) -> Scene:
    return without_robot(scene)


def recon_camera(angle: float) -> Camera:
    eye = [-0.2 + 1.9 * np.cos(angle), 1.9 * np.sin(angle), 0.8]
    world = Camera(
        fx=95.0, fy=95.0, cx=60.0, cy=45.0, width=120, height=90,
        T_world_cam=look_at(eye, [-0.2, 0.0, 0.35]),
    )  # fmt: skip
    return camera_in_world(np.array(np.linalg.inv(S_WORLD_RECON), np.float64), world)


def solvable(scene: Scene) -> bool:
    return is_solvable(scene.views, scene.robot_boxes, scene.configuration, scene.S_world_recon)


def where_seen(scene: Scene) -> np.ndarray:
    """Where each view shows the robot's points: (views, points, 2), [px]."""
    points = scene.configuration.points_world(50)
    return np.array(
        [camera_in_world(scene.S_world_recon, v.camera_recon).project(points)[0] for v in scene.views]
    )


def test_another_frame_shows_the_same(scene):
    turned = resimilated(scene, 7.0, matrix_from_rotvec([1.0, 2.0, -0.5]), np.random.default_rng(0))
    assert where_seen(turned) == pytest.approx(where_seen(scene), abs=1e-6)
    assert similarity_parts(turned.S_world_recon)[0] == pytest.approx(0.6 / 7)


def test_the_robot_is_painted_over(scene, bare):
    assert all((view.image_srgb == ROBOT_SRGB).any() for view in scene.views)
    assert not any((view.image_srgb > WALL_SRGB + 5).any() for view in bare.views)


def test_a_mirrored_scene_is_consistent_in_itself(scene):
    """A point and its mirror image are seen at mirrored pixels."""
    points = np.random.default_rng(1).normal(0, 0.3, (20, 3)) + scene.views[0].camera_recon.T_world_cam[:3, 2]
    turned = mirrored(scene)
    for before, after in zip(scene.views, turned.views, strict=True):
        pixels, z = before.camera_recon.project(points)
        other, z_other = after.camera_recon.project(points * [-1.0, 1.0, 1.0])
        assert z_other == pytest.approx(z)
        assert other == pytest.approx([120.0, 0.0] + pixels * [-1.0, 1.0])
        assert np.array_equal(after.image_srgb, before.image_srgb[:, ::-1])


@pytest.mark.parametrize("kind", UNSOLVABLE)
def test_unsolvable_kinds_take_away_what_the_answer_needs(scene, bare, kind):
    case = make_case(scene, bare, kind, np.random.default_rng(2))
    if kind in ("absent", "elsewhere"):
        assert not any((view.image_srgb > WALL_SRGB + 5).any() for view in case.scene.views)
    elif kind == "joints":
        off_deg = np.degrees(np.abs(case.scene.configuration.joints - JOINTS))
        assert off_deg[0] == 0
        assert 10 <= off_deg.max() <= 40
    else:
        assert all(view.camera_recon.cx == 60 for view in case.scene.views)
        assert np.linalg.det(case.scene.views[0].camera_recon.T_world_cam[:3, :3]) == pytest.approx(1.0)
    boxes = [box.box_px for box in case.scene.robot_boxes]
    assert (len(boxes) == 1) == (kind == "elsewhere")


def test_solvable_cases_are_solvable_and_differ(scene, bare):
    rng = np.random.default_rng(3)
    cases = [make_case(scene, bare, "solvable", rng) for _ in range(30)]
    assert all(solvable(case.scene) for case in cases)
    words = {word for case in cases for word in case.done[:-1]}
    assert words == {"boxes off", "one box", "cut images", "shaken cameras", "fewer views"}
    scales = [similarity_parts(case.scene.S_world_recon)[0] / 0.6 for case in cases]
    assert 0.05 <= min(scales) < 0.5
    assert 2 < max(scales) <= 20


def test_a_case_knows_its_answer(scene, bare):
    """The robot's pixels are where the case's own answer puts them."""
    case = make_case(scene, bare, "solvable", np.random.default_rng(5)).scene
    for view in case.views:
        camera = camera_in_world(case.S_world_recon, view.camera_recon)
        pixels, _ = camera.project(case.configuration.points_world(400))
        u, v = np.floor(pixels).astype(int).T
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        assert (view.image_srgb[v[inside], u[inside], 0] == ROBOT_SRGB).mean() > 0.75


def test_few_views_are_not_solvable(scene):
    assert solvable(scene)
    assert not solvable(replace(scene, views=scene.views[:5]))


def test_views_from_one_side_are_not_solvable(scene):
    assert not solvable(replace(scene, views=scene.views[:2] * 4))


def test_views_that_miss_the_robot_are_not_solvable(scene):
    away = [replace(view, camera_recon=replace(view.camera_recon, cx=-60.0)) for view in scene.views]
    assert not solvable(replace(scene, views=away))


def test_boxes_beside_the_robot_are_not_solvable(scene):
    assert not solvable(replace(scene, robot_boxes=[]))
    assert not solvable(replace(scene, robot_boxes=scene.other_boxes))


def outcome(kind: str, error_m: float | None, *, refused: bool = False) -> Outcome:
    return Outcome(
        scene="drawn", kind=kind, done=(), refusal="why" if refused else "",
        error_m=error_m, sd_m=None if refused else 0.001, seconds=1.0,
    )  # fmt: skip


def test_answers_are_counted():
    figures = summary(
        [
            outcome("solvable", 0.001),
            outcome("solvable", 0.003),
            outcome("solvable", 0.02),
            outcome("solvable", None, refused=True),
            outcome("absent", None, refused=True),
            outcome("joints", None),
        ]
    )
    assert figures["solvable_answered"] == 0.5
    assert figures["answered_wrongly"] == 2
    assert figures["unsolvable_refused"] == 0.5
    assert figures["end_effector_mm_worst"] == pytest.approx(20)
    assert figures["median_error_in_sd"] == pytest.approx(2.0)
