"""Where the scan looked: places, sides, warnings."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aomgen.core.camera import Camera, camera_in_world, look_at
from aomgen.core.transforms import apply, similarity
from aomgen.parts.survey import (
    Coverage,
    Survey,
    compute_coverage,
    list_object_sides,
    list_table_sides,
    survey,
)
from aomgen.robots.robot import RobotConfiguration
from aomgen.splatting.surfaces import ViewDepth, view_depths

MIDDLE = np.array([0.45, -0.05, 0.15])


def camera_at(eye, target, width: int = 160) -> Camera:
    height = width * 3 // 4
    return Camera(
        fx=0.9 * width, fy=0.9 * width, cx=width / 2, cy=height / 2, width=width, height=height,
        T_world_cam=look_at(eye, target),
    )  # fmt: skip


def empty_view(camera: Camera, depth: float = np.inf) -> ViewDepth:
    return ViewDepth(camera=camera, depth=np.full((camera.height, camera.width), depth, np.float32))


def ring() -> list[Camera]:
    """Three arcs all around robot and object, the lowest one low."""
    angles = np.radians(np.arange(0, 360, 20))
    return [
        camera_at(MIDDLE + [r * np.cos(a), r * np.sin(a), h], MIDDLE)
        for r, h in ((1.5, 0.15), (1.4, 0.5), (1.0, 0.9))
        for a in angles
    ]


def survey_of(scene, cameras: list[Camera]) -> Survey:
    configuration = RobotConfiguration(robot=scene.robot, joints=scene.twin.scan_state.joints, gripper=0.0)
    views = view_depths(scene.gaussians, cameras)
    return survey(scene.gaussians, scene.labels, configuration, views, np.random.default_rng(0))


@pytest.fixture(scope="module")
def full(toy_scene) -> Survey:
    return survey_of(toy_scene, ring())


def test_a_full_scan_warns_of_nothing(full: Survey):
    assert full.warnings() == []
    assert len(full.names) == 14


@pytest.mark.parametrize(
    ("side", "outward"),
    [("far", [1.0, 0.0]), ("near", [-1.0, 0.0]), ("left", [0.0, 1.0]), ("right", [0.0, -1.0])],
)
def test_a_scan_without_one_side_warns_of_it(toy_scene, side: str, outward: list[float]):
    """Cameras within 100 degrees of a side's normal are taken away."""
    kept = [
        camera
        for camera in ring()
        if (camera.center - MIDDLE)[:2] @ outward
        < np.cos(np.radians(100)) * np.linalg.norm((camera.center - MIDDLE)[:2])
    ]
    found = survey_of(toy_scene, kept)
    name = f"the {side} side of the object"
    warned = [sentence for sentence in found.warnings() if sentence.startswith(name)]
    assert warned == [
        f"{name} is covered by 0 views, expected 3; its surface is guessed, add scan images that show it"
    ]
    opposite = {"far": "near", "near": "far", "left": "right", "right": "left"}[side]
    assert not any(f"the {opposite} side of the object" in sentence for sentence in found.warnings())
    if side == "near":
        assert any(sentence.startswith("the back of the robot") for sentence in found.warnings())


def test_views_from_one_direction_do_not_decide_depth(toy_scene):
    eyes = [MIDDLE + [-0.9, 0.01 * k - 1.1, 0.4] for k in range(5)]
    found = survey_of(toy_scene, [camera_at(eye, MIDDLE) for eye in eyes])
    near = next(s for s in found.warnings() if s.startswith("the near side of the object"))
    assert "from one direction (over " in near


def test_what_stands_before_a_place_hides_it():
    view = empty_view(camera_at([0, 0, 0], [0, 1, 0]), depth=2.0)
    on, before, behind, outside = [0, 2.0, 0], [0, 1.0, 0], [0, 2.2, 0], [5.0, 2.0, 0]
    assert compute_coverage(np.array([on, before, behind, outside]), [view]).views.tolist() == [1, 1, 0, 0]
    assert np.isnan(view.behind(np.array([outside]))[0])
    assert compute_coverage(np.array([[0, -2.0, 0]]), [view]).views.tolist() == [0]


def test_a_side_that_is_turned_away_is_not_seen():
    view = empty_view(camera_at([0, 0, 0], [0, 1, 0]))
    normals = np.array([[0, -1.0, 0], [0, 1.0, 0], [1.0, -0.1, 0] / np.sqrt(1.01)])
    assert compute_coverage(np.tile([0, 2.0, 0], (3, 1)), [view], normals).views.tolist() == [1, 0, 0]


def test_spread_is_the_angle_between_the_outermost_views():
    eyes = [[np.sin(a), -np.cos(a), 0] for a in np.radians([-20, 0, 20])]
    found = compute_coverage(np.zeros((1, 3)), [empty_view(camera_at(eye, [0, 0, 0])) for eye in eyes])
    assert found.views.tolist() == [3]
    assert found.spread_deg[0] == pytest.approx(40, abs=2)
    alone = compute_coverage(np.zeros((1, 3)), [empty_view(camera_at(eyes[0], [0, 0, 0]))])
    assert (alone.views.tolist(), float(alone.spread_deg[0])) == ([1], pytest.approx(0, abs=0.1))
    assert compute_coverage(np.zeros((2, 3)), []).views.tolist() == [0, 0]


@pytest.mark.parametrize("scale", [0.05, 20.0])
def test_coverage_is_the_same_in_any_frame(scale: float):
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (200, 3))
    S = similarity(scale, Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), np.array([1.0, -2.0, 3.0]))
    cameras = [camera_at(eye, [0, 0, 0]) for eye in rng.normal(size=(6, 3)) * 2]
    depths = rng.uniform(1.0, 4.0, (6, 120, 160)).astype(np.float32)
    here = [ViewDepth(camera=camera, depth=depth) for camera, depth in zip(cameras, depths, strict=True)]
    there = [
        ViewDepth(camera=camera_in_world(S, view.camera), depth=view.depth * np.float32(scale))
        for view in here
    ]
    first, second = compute_coverage(points, here), compute_coverage(apply(S, points), there)
    assert np.mean(first.views == second.views) > 0.99  # rounding moves a pixel now and then
    assert 0.1 < first.enough.mean() < 0.9


def test_sides_are_named_as_the_robot_sees_them():
    """A box before a robot that looks along -y: its left is +x."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.2, -1.1, 0.0], [0.2, -0.9, 0.3], (4000, 3))
    forward = np.array([0.0, -1.0])
    normals = {name: own[0] for name, _, own in list_object_sides(points, forward)}
    assert normals["the near side of the object"] == pytest.approx([0, 1, 0], abs=0.02)
    assert normals["the left side of the object"] == pytest.approx([1, 0, 0], abs=0.02)
    assert normals["the top of the object"] == pytest.approx([0, 0, 1])
    middles = {name: own.mean(0) for name, own, _ in list_table_sides(points, forward)}
    assert middles["the table behind the object"][1] < -1.1
    assert middles["the table right of the object"][0] < -0.2
    assert middles["the table before the object"][2] == pytest.approx(0.0, abs=0.01)


def test_a_side_seen_in_part_says_so():
    found = Survey(
        names=("the top of the robot",),
        points_world=np.zeros((10, 3)),
        sides=np.zeros(10),
        coverage=Coverage(
            views=np.r_[np.full(6, 4), np.zeros(4)], spread_deg=np.r_[np.full(4, 30), np.full(6, 10)]
        ),
    )
    assert found.warnings() == []
    less = Survey(
        names=found.names,
        points_world=np.zeros((10, 3)),
        sides=np.zeros(10),
        coverage=Coverage(views=np.full(10, 4), spread_deg=np.r_[np.full(4, 30), np.full(6, 0)]),
    )
    assert "from one direction" in less.warnings()[0]
