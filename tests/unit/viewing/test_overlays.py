from dataclasses import replace

import mujoco
import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.joint import Joint
from aomgen.twin.twin import TwinState
from aomgen.viewing.lines import outline_geoms, outline_hull, project_segments
from aomgen.viewing.observed import describe_support, project_coverage
from aomgen.viewing.overlays import (
    Moment,
    outline_cameras,
    outline_colliders,
    outline_contacts,
    outline_patches,
)

CAMERA = Camera(
    fx=100, fy=100, cx=50, cy=40, width=100, height=80, T_world_cam=look_at((-1, 0, 0), (0, 0, 0))
)
SHAPES = """<mujoco><worldbody><body pos="1 2 3"><joint name="slide" type="slide" axis="1 0 0"/>
<geom name="a" type="capsule" size=".1 .3"/><geom name="b" type="box" size=".1 .2 .3"/>
<geom name="c" type="sphere" size=".2" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""


def moment(theta: float = 0.0, time_s: float = 0.0) -> Moment:
    return Moment(
        TwinState(joints=np.zeros(6), gripper=0.0, theta=theta, T_world_object=np.eye(4)), time_s, CAMERA
    )


def test_segments_are_cut_at_the_camera():
    seen = project_segments(CAMERA, [[[0, 0, 0], [0, 0, 0.1]], [[0, 0, 0], [-3, 0.1, 0]], [[-2, 0, 0], [-3, 0, 0]]])  # fmt: skip
    assert len(seen) == 2
    np.testing.assert_allclose(seen[0], [50, 40, 50, 30], atol=1e-9)
    # The second one leaves the image at the left, along the line to its end behind the camera.
    assert seen[1][2] < 0


def test_an_outline_is_as_large_as_its_shape():
    model = mujoco.MjModel.from_xml_string(SHAPES)
    capsule, box = outline_geoms(model)
    np.testing.assert_allclose(np.abs(capsule[1]).max((0, 1)), [0.1, 0.1, 0.4], atol=1e-3)
    assert len(box[1]) == 12
    tetrahedron = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    assert len(outline_hull(tetrahedron)) == 6


def test_colliders_move_with_their_bodies():
    model = mujoco.MjModel.from_xml_string(SHAPES)
    colliders = outline_colliders(model, lambda state: np.array([state.theta]))
    shift = colliders(moment(0.5))["collider"] - colliders(moment(0.0))["collider"]
    np.testing.assert_allclose(shift, np.broadcast_to([0.5, 0, 0], shift.shape), atol=1e-12)
    marked = outline_colliders(model, lambda state: np.array([state.theta]), ["b"])(moment())
    assert (len(marked["pair"]), len(marked["pair"]) + len(marked["collider"])) == (12, len(shift))


def test_the_own_camera_is_not_drawn():
    other = CAMERA.move(look_at((-1, 1, 0), (0, 0, 0)))
    drawn = outline_cameras({"0.jpg": CAMERA, "1.jpg": other}, {}, 0.05)(moment())
    assert drawn["scan"].shape == (8, 2, 3)
    assert drawn["fixed"].shape == (0, 2, 3)


def test_patches_are_carried_by_the_part(toy_motion):
    joint = Joint(type="prismatic", axis=(0, 1, 0), origin=(0, 0, 0), lower=0, upper=1)
    overlay = outline_patches(toy_motion(joint))
    assert not len(overlay(moment(0.0, 1.0))["contact"])
    (arrow,) = overlay(moment(0.3, 4.0))["contact"]
    np.testing.assert_allclose(arrow[0] - toy_motion(joint).contacts[0].point, [0, 0.3, 0], atol=1e-12)


def test_contacts_of_a_frame(toy_episode_7):
    overlay = outline_contacts(toy_episode_7)
    assert not len(overlay(moment(time_s=0.0))["contact"])
    (arrow,) = overlay(moment(time_s=0.41))["contact"]
    np.testing.assert_allclose(arrow[1] - arrow[0], [0, 0, 0.04], atol=1e-12)


def test_coverage_behind_a_surface_is_hidden(toy_survey):
    camera = CAMERA.move(look_at((-1, -0.1, 0.1), (0, -0.1, 0.1)))
    near = np.full((80, 100), 1.4, np.float32)
    assert [row[2] for row in project_coverage(toy_survey, camera, near, with_robot=True)] == [2]
    assert [row[2] for row in project_coverage(toy_survey, camera, 0 * near, with_robot=True)] == [2, 0]
    robots = replace(toy_survey, names=("the near side of the object", "the top of the robot"))
    assert len(project_coverage(robots, camera, 0 * near, with_robot=False)) == 1


@pytest.mark.parametrize(
    ("eye", "words"),
    [((-1, 0, 0), []), ((0.7, 2, 0), ["scan camera looks from"]), ((3, 0, 0), ["scan camera", "far side"])],
)
def test_views_without_support_are_named(toy_survey, eye, words):
    pivot = np.array([0.65, -0.1, 0.1])
    camera = CAMERA.move(look_at(eye, pivot))
    found = describe_support(camera, np.ones((80, 100)), {"0.jpg": CAMERA}, pivot, toy_survey)
    assert len(found) == len(words)
    assert all(word in sentence for word, sentence in zip(words, found, strict=True))
    empty = describe_support(camera, np.zeros((80, 100)), {"0.jpg": CAMERA}, pivot, None)
    assert "100%" in empty[0]
