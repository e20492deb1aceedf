"""Places that boxes allow, and the quick look at colors that chooses among them."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.pose_search import (
    ColorScore,
    Scan,
    divergence,
    search_poses,
    select_distinct,
)
from aomgen.alignment.starting_poses import RobotBox, find_starting_poses
from aomgen.core.camera import Camera, camera_in_world, look_at
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity
from aomgen.core.values import Array
from aomgen.robots.robot import RobotConfiguration, RobotModel
from aomgen.robots.silhouette import SilhouetteRenderer

JOINTS = np.array([3.5, -2.2, 2.4, 0.25, 1.35, 0.0])
S_WORLD_RECON = similarity(0.8, matrix_from_rotvec([0.4, -0.7, 1.0]), [0.4, -0.2, 0.9])
S_RECON_WORLD = np.array(np.linalg.inv(S_WORLD_RECON), np.float64)
UP_RECON = np.array(S_WORLD_RECON[2, :3] / np.linalg.norm(S_WORLD_RECON[2, :3]), np.float64)
SIZE = np.array([160, 120])


@pytest.fixture(scope="module")
def configuration(robot: RobotModel) -> RobotConfiguration:
    return RobotConfiguration(robot=robot, joints=JOINTS, gripper=0.1)


@pytest.fixture(scope="module")
def views(configuration: RobotConfiguration) -> list[AlignmentImage]:
    """A gray robot before a blotchy wall of other colors."""
    rng = np.random.default_rng(0)
    found = []
    with SilhouetteRenderer(configuration.robot, max_width=160, max_height=120, cell_m=0.01) as renderer:
        for index in range(5):
            camera = recon_camera(0.5 * index)
            bodies, _ = renderer.draw(camera_in_world(S_WORLD_RECON, camera), JOINTS, 0.1)
            wall = np.kron(rng.uniform(0, 255, (12, 16, 3)), np.ones((10, 10, 1)))
            image = np.where((bodies >= 0)[..., None], 130 + rng.normal(0, 8, (120, 160, 1)), wall)
            found.append(
                AlignmentImage(name=f"{index}", camera_recon=camera, image_srgb=image.astype(np.uint8))
            )
    return found


def recon_camera(angle: float) -> Camera:
    eye = [-0.2 + 1.9 * np.cos(angle), 1.9 * np.sin(angle), 0.8]
    world = Camera(
        fx=130.0, fy=130.0, cx=80.0, cy=60.0, width=160, height=120,
        T_world_cam=look_at(eye, [-0.2, 0.0, 0.35]),
    )  # fmt: skip
    return camera_in_world(S_RECON_WORLD, world)


def box_on(configuration: RobotConfiguration, camera: Camera) -> RobotBox:
    pixels, _ = camera.project(apply(S_RECON_WORLD, configuration.points_world()))
    pixels = np.clip(pixels, 0, SIZE)
    return RobotBox(camera_recon=camera, box_px=np.concatenate([pixels.min(0), pixels.max(0)]))


def test_a_box_cut_by_the_border_holds_what_the_picture_shows(configuration: RobotConfiguration) -> None:
    """The upper arm is out of the picture; the box ends where the picture does, and its sides are the rest's."""
    boxes = []
    for angle in (0.3, 1.6):
        whole = recon_camera(angle)
        camera = replace(whole, cy=whole.cy - 65.0)
        pixels, _ = camera.project(apply(S_RECON_WORLD, configuration.points_world()))
        shown = pixels[((pixels >= 0) & (pixels <= SIZE)).all(1)]
        boxes.append(RobotBox(camera_recon=camera, box_px=np.concatenate([shown.min(0), shown.max(0)])))
        assert pixels[:, 1].min() < -10
    Ss, scores = places(configuration, boxes)
    good = scores >= np.quantile(scores, 0.75)
    assert off_m(Ss[good], configuration).min() < 0.05


def off_m(Ss_world_recon: Array, configuration: RobotConfiguration) -> Array:
    """Mean distance (H,) of the robot from where it stands, [m]."""
    points = configuration.points_world(100)
    placed = [apply(S @ S_RECON_WORLD, points) for S in Ss_world_recon]
    return np.array([np.linalg.norm(moved - points, axis=1).mean() for moved in placed])


def places(configuration: RobotConfiguration, boxes: list[RobotBox], count: int = 400):
    points = apply(S_RECON_WORLD, np.random.default_rng(1).uniform(-1, 1, (300, 3)))
    return find_starting_poses(
        boxes, configuration.points_world(), [UP_RECON], points, np.random.default_rng(2), count
    )


def test_two_boxes_leave_one_place_for_a_heading(configuration):
    Ss, scores = places(configuration, [box_on(configuration, recon_camera(a)) for a in (0.0, 1.3)])
    # Every fourth guess keeps the boxes as they were drawn.
    best = int(np.argmax(np.where(np.arange(400) % 4 == 0, scores, -9)))
    assert off_m(Ss[[best]], configuration)[0] < 0.03
    assert scores[best] > -0.01


def test_one_box_leaves_the_depth_open(configuration):
    Ss, scores = places(configuration, [box_on(configuration, recon_camera(0.0))])
    good = Ss[scores > -0.03]
    scales = np.cbrt(np.linalg.det(good[:, :3, :3]))
    assert len(good) > 60
    assert np.percentile(scales, 90) > 1.5 * np.percentile(scales, 10)
    assert off_m(good, configuration).min() < 0.1


def test_a_side_on_the_border_lets_the_robot_reach_farther(configuration):
    """The box is cut to half of the robot; held to its sides, the robot would have to be smaller."""
    camera = recon_camera(0.0)
    whole = box_on(configuration, camera)
    middle = round(float(whole.box_px[[0, 2]].mean()))
    cut = Camera(
        fx=130.0, fy=130.0, cx=80.0, cy=60.0, width=middle, height=120, T_world_cam=camera.T_world_cam
    )
    sides = np.append(whole.box_px[:2], [middle, whole.box_px[3]])
    Ss, scores = places(
        configuration, [RobotBox(camera_recon=cut, box_px=sides), box_on(configuration, recon_camera(1.3))]
    )
    assert off_m(Ss[scores > -0.05], configuration).min() < 0.06


def test_colors_single_out_where_the_robot_stands(configuration, views):
    score = ColorScore(views, configuration, np.random.default_rng(3))
    rng = np.random.default_rng(4)
    moved = []
    for _ in range(60):
        D = similarity(np.exp(rng.normal(0, 0.1)), matrix_from_rotvec(rng.normal(0, 0.3, 3)), np.zeros(3))
        D[:3, 3] = rng.normal(0, 0.15, 3)
        moved.append(D @ S_WORLD_RECON)
    scores = score(np.array([S_WORLD_RECON, *moved]))
    far = off_m(np.array(moved), configuration) > 0.1
    assert far.sum() > 20
    assert scores[0] > 2 * scores[1:][far].max()


def test_a_robot_out_of_sight_scores_nothing(configuration, views):
    score = ColorScore(views, configuration, np.random.default_rng(3))
    behind = S_WORLD_RECON.copy()
    behind[2, 3] += 30.0
    assert score(behind[None])[0] == 0.0


def test_few_counts_differ_by_chance_only():
    rng = np.random.default_rng(5)
    p = rng.dirichlet(np.ones(20))
    same = divergence(rng.multinomial(150, p, 200).astype(float), rng.multinomial(400, p, 200).astype(float))
    assert same.mean() < 0.02
    apart = divergence(np.array([[100.0, 0.0]]), np.array([[0.0, 300.0]]))
    assert apart[0] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("careless", [False, True])
def test_the_search_ends_near_the_robot(configuration, views, careless):
    boxes = [box_on(configuration, views[index].camera_recon) for index in (0, 3)]
    if careless:
        boxes = [RobotBox(camera_recon=boxes[0].camera_recon, box_px=boxes[0].box_px + [4, 3, 4, 3])]
    rng = np.random.default_rng(6)
    points = apply(S_RECON_WORLD, rng.uniform(-1, 1, (300, 3)))
    Ss, _ = search_poses(
        Scan(views=views, boxes=boxes, points_recon=points),
        configuration,
        rng,
        guesses=1200 if len(boxes) > 1 else 2400,
    )
    assert off_m(Ss[:1], configuration)[0] < 0.06


def test_places_returned_are_far_from_one_another():
    Ss = np.tile(np.eye(4), (4, 1, 1))
    Ss[:, 0, 3] = [0.0, 0.05, 1.0, 2.0]
    points = np.random.default_rng(7).normal(0, 1, (50, 3))
    kept, scores = select_distinct(Ss, np.array([0.5, 0.6, 0.1, 0.4]), points, 0.3, 2)
    assert kept[:, 0, 3] == pytest.approx([0.05, 2.0])
    assert scores == pytest.approx([0.6, 0.4])
