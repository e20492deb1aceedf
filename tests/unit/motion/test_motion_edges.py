"""Boxes and their edges."""

import numpy as np
import pytest

from aomgen.core.transforms import angle_between
from aomgen.errors import InputError
from aomgen.motion.edges import edge_costs, edge_prior, footprint_yaw, upright_box
from aomgen.motion.joint import estimate_joint

YAW = 0.4
R = np.array([[np.cos(YAW), -np.sin(YAW), 0], [np.sin(YAW), np.cos(YAW), 0], [0, 0, 1.0]])


def box_points(low: tuple, high: tuple, seed: int = 0, count: int = 3000) -> np.ndarray:
    """Points on the surface of a box that is turned by YAW."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(low, high, (count, 3))
    faces = rng.integers(0, 6, count)
    points[np.arange(count), faces % 3] = np.where(
        faces < 3, np.array(low)[faces % 3], np.array(high)[faces % 3]
    )
    return points @ R.T


# A microwave in its own frame: front towards -y, door hinged at x = -0.22, handle at x = 0.18.
BODY = box_points((-0.22, -0.14, 0), (0.22, 0.2, 0.26))
DOOR = box_points((-0.22, -0.17, 0.01), (0.22, -0.145, 0.25), 1)
HANDLE = R @ [0.18, -0.2, 0.13]
FRONT = R @ [0, -1.0, 0]


def test_a_box_has_twelve_edges_of_three_directions() -> None:
    box = upright_box(BODY, footprint_yaw(BODY))
    edges = box.edges()
    assert edges.shape == (12, 2, 3)
    assert len(np.unique(np.round(edges.mean(1), 6), axis=0)) == 12
    assert 2 * np.sort(box.half_extents) == pytest.approx([0.26, 0.34, 0.44], abs=0.01)


def test_the_yaw_of_a_turned_box_is_found() -> None:
    assert footprint_yaw(BODY) == pytest.approx(YAW, abs=np.radians(1))


def test_the_hinge_is_far_from_the_handle() -> None:
    prior = edge_prior(BODY, DOOR, HANDLE, FRONT)
    assert np.degrees(min(angle_between(prior.revolute_axis, [0, 0, s]) for s in (1, -1))) < 1
    hinge = R @ [-0.22, -0.145, 0.13]
    assert np.linalg.norm((prior.revolute_origin - hinge)[:2]) < 0.05
    assert np.degrees(angle_between(prior.face_normal, FRONT)) < 2


def test_the_sign_as_printed_in_the_paper_would_take_the_handle_side() -> None:
    yaw = footprint_yaw(BODY)
    body, door = upright_box(BODY, yaw), upright_box(DOOR, yaw)
    ours = edge_costs(body, door, HANDLE, FRONT, "revolute")
    chosen = door.edges()[np.unravel_index(np.argmin(ours), ours.shape)[1]].mean(0)
    assert (R.T @ chosen)[0] < -0.15


def test_a_drawer_runs_along_the_hands_motion() -> None:
    prior = edge_prior(BODY, DOOR, HANDLE, FRONT)
    assert np.degrees(min(angle_between(prior.prismatic_axis, s * FRONT) for s in (1, -1))) < 2


def test_too_few_points_are_refused() -> None:
    with pytest.raises(InputError, match="need 20"):
        edge_prior(BODY, DOOR[:5], HANDLE, FRONT)


def test_the_prior_helps_a_short_arc() -> None:
    hinge = R @ [-0.22, -0.14, 0.13]
    angles = np.radians(20) * 0.5 * (1 - np.cos(np.linspace(0, np.pi, 200)))
    rng = np.random.default_rng(2)
    offset = HANDLE - hinge
    c, s = np.cos(angles), np.sin(angles)
    turned = np.stack(
        [c * offset[0] + s * offset[1], -s * offset[0] + c * offset[1], np.full(200, offset[2])], 1
    )
    poses = np.repeat(np.eye(4)[None], 200, 0)
    poses[:, :3, 3] = hinge + turned + rng.normal(size=(200, 3)) * 0.001
    prior = edge_prior(BODY, DOOR, HANDLE, FRONT)

    def error(edges) -> float:
        joint = estimate_joint(poses, np.zeros(3), edges).joint
        return float(np.linalg.norm(np.cross(hinge - joint.origin, joint.axis)))

    assert error(prior) < 0.04
    assert error(prior) <= error(None) + 0.002
