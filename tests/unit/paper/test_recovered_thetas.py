"""Plane and trajectory: exact paths give their own joint values back."""

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.paper.motion_estimate import recover_thetas

AXIS = np.array([0.1, -0.2, 0.97]) / np.linalg.norm([0.1, -0.2, 0.97])
HINGE = Joint(type="revolute", axis=AXIS, origin=np.array([0.5, 0.2, 0.3]), lower=0, upper=1.5)
SLIDE = Joint(type="prismatic", axis=np.array([0.0, -1.0, 0.0]), origin=np.zeros(3), lower=0, upper=0.3)
CONTACT = np.array([0.45, -0.15, 0.35])
NORMAL = np.array([-0.98, 0.1, 0.17]) / np.linalg.norm([-0.98, 0.1, 0.17])
THETAS = np.linspace(0, 1.4, 40)


def intersections(plane_point: Array, plane_normal: Array, path: Array) -> Array:
    """Points (K, 3) in which a plane meets a path (T, 3) of straight pieces; a path inside it is not met."""
    heights = (path - plane_point) @ plane_normal
    first, second = heights[:-1], heights[1:]
    crossed = (first * second <= 0) & (first != second)
    shares = (first / np.where(crossed, first - second, 1.0))[crossed, None]
    return path[:-1][crossed] * (1 - shares) + path[1:][crossed] * shares


def recovery_error(
    joint: Joint, plane_point: Array, plane_normal: Array, path: Array, frame: int, theta: float
) -> float:
    """The paper's f(theta) at one frame: from PC_r,t to the nearest intersection, [m]; infinite without any.

    Args:
        joint: World frame.
        plane_point, plane_normal: The face's plane at theta 0, world frame, (3,) each.
        path: The contact's trajectory PC_r (T, 3), [m].
        frame: Which of them is PC_r,t.
        theta: Joint value, [rad] or [m].
    """
    T = joint.motion(theta)
    met = intersections(apply(T, plane_point), T[:3, :3] @ plane_normal, path)
    return float(np.linalg.norm(met - path[frame], axis=1).min()) if len(met) else float("inf")


def test_an_exact_arc_gives_its_angles():
    path = apply(HINGE.motion(THETAS), CONTACT)
    assert recover_thetas(HINGE, CONTACT, NORMAL, path) == pytest.approx(THETAS, abs=1e-9)


def test_an_arc_the_other_way_gives_negative_angles():
    path = apply(HINGE.motion(-THETAS), CONTACT)
    assert recover_thetas(HINGE, CONTACT, NORMAL, path) == pytest.approx(-THETAS, abs=1e-9)


def test_sliding_along_the_face_changes_nothing():
    """What the plane is good for: a hand that slides outwards on the door gives the same angles."""
    across = np.cross(AXIS, NORMAL) / np.linalg.norm(np.cross(AXIS, NORMAL))
    slid = CONTACT + np.outer(np.linspace(0, 0.03, len(THETAS)), across)
    path = np.array([apply(T, point) for T, point in zip(HINGE.motion(THETAS), slid, strict=True)])
    assert recover_thetas(HINGE, CONTACT, NORMAL, path) == pytest.approx(THETAS, abs=1e-9)


def test_an_exact_line_gives_its_distances():
    distances = np.linspace(0, 0.2, 30)
    path = apply(SLIDE.motion(distances), CONTACT)
    tilted = np.array([0.3, -0.95, 0.0]) / np.linalg.norm([0.3, -0.95, 0.0])
    assert recover_thetas(SLIDE, CONTACT, tilted, path) == pytest.approx(distances, abs=1e-12)


def test_a_plane_that_slides_within_itself_tells_nothing():
    path = apply(SLIDE.motion(np.linspace(0, 0.2, 30)), CONTACT)
    assert not np.any(recover_thetas(SLIDE, CONTACT, np.array([0.0, 0.0, 1.0]), path))
    assert not np.any(recover_thetas(HINGE, CONTACT, AXIS, path))


def test_a_law_of_rigid_motion():
    T = transform(matrix_from_rotvec(np.array([0.4, -1.1, 0.3])), np.array([1.0, 2.0, -0.5]))
    path = apply(HINGE.motion(THETAS), CONTACT) + np.random.default_rng(0).normal(0, 0.002, (40, 3))
    moved = recover_thetas(HINGE.move(T), apply(T, CONTACT), T[:3, :3] @ NORMAL, apply(T, path))
    assert moved == pytest.approx(recover_thetas(HINGE, CONTACT, NORMAL, path), abs=1e-9)


@pytest.mark.parametrize("frame", [1, 12, 38])
def test_the_closed_form_is_where_the_printed_distance_vanishes(frame):
    """And nothing near it does as well: the distance is the plane's and the path's, not the formula's."""
    path = apply(HINGE.motion(THETAS), CONTACT) + np.random.default_rng(1).normal(0, 0.001, (40, 3))
    theta = float(recover_thetas(HINGE, CONTACT, NORMAL, path)[frame])
    at = recovery_error(HINGE, CONTACT, NORMAL, path, frame, theta)
    assert at < 1e-9
    for other in (theta - 0.02, theta + 0.02):
        assert recovery_error(HINGE, CONTACT, NORMAL, path, frame, other) > 1e-3


def test_a_plane_meets_a_zigzag_wherever_it_crosses():
    path = np.array([[0.0, 0, 0], [0, 0, 2], [0, 1, 2], [0, 1, 0]])
    met = intersections(np.array([5.0, 5, 0.5]), np.array([0.0, 0, 1]), path)
    assert met == pytest.approx(np.array([[0, 0, 0.5], [0, 1, 0.5]]))
    assert not len(intersections(np.array([0.0, 0, 3]), np.array([0.0, 0, 1]), path))


def test_no_intersection_is_infinitely_far():
    far = recovery_error(SLIDE, CONTACT, np.array([0.0, -1, 0]), np.zeros((5, 3)), 0, 1.0)
    assert far == float("inf")


def test_a_contact_that_no_plane_reaches_takes_the_nearest():
    """The face passes 0.3 m from the axis; a point 0.1 m from it is met by no turn of the plane."""
    joint = Joint(type="revolute", axis=np.array([0.0, 0, 1]), origin=np.zeros(3), lower=0, upper=1)
    found = recover_thetas(
        joint,
        np.array([0.3, 0, 0]),
        np.array([1.0, 0, 0]),
        np.array([[0.1 * np.cos(0.5), 0.1 * np.sin(0.5), 0]]),
    )
    assert found == pytest.approx([0.5])
