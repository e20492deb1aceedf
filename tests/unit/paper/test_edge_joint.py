"""The paper's edge cost on boxes whose hinge is known."""

from itertools import product

import numpy as np
import pytest

from aomgen.core.boxes import OrientedBox
from aomgen.core.joint import JointType
from aomgen.core.transforms import angle_between
from aomgen.errors import InputError
from aomgen.paper.edge_joint import box_joint, pair_costs, score_edge_pairs
from aomgen.paper.mask_keyframes import Variant

# Two unit boxes side by side along y: the moving one in front, its handle at x = 0.4.
STATIC = OrientedBox(T_world_box=np.eye(4), half_extents=np.full(3, 0.5))
IN_FRONT = np.eye(4)
IN_FRONT[1, 3] = -1.0
MOVING = OrientedBox(T_world_box=IN_FRONT, half_extents=np.full(3, 0.5))
HANDLE = np.array([0.4, -1.5, 0.0])
APPROACH = np.array([0.0, 1.0, 0.0])


def chosen(joint_type, signs, direction=APPROACH):
    costs = pair_costs((STATIC, MOVING), HANDLE, direction, joint_type, signs)
    pair = np.unravel_index(int(np.argmin(costs)), costs.shape)
    return STATIC.edges()[pair[0]], MOVING.edges()[pair[1]]


def test_a_cost_is_what_the_formula_says():
    """Vertical edges on top of each other at x = 0.5, y = -0.5; diagonal sqrt(3); contact off by (0.1, 1)."""
    vertical = [
        (i, j)
        for i, j in product(range(12), range(12))
        if np.allclose(STATIC.edges()[i], MOVING.edges()[j])
        and np.allclose(STATIC.edges()[i][:, 0], 0.5)
        and np.ptp(STATIC.edges()[i][:, 2]) == 1
    ]
    assert len(vertical) == 1
    reach = np.hypot(0.1, 1.0) / np.sqrt(3)
    cases: list[tuple[JointType, Variant, float]] = [
        ("revolute", "printed", reach),
        ("revolute", "repaired", -reach),
        ("prismatic", "printed", -reach),
        ("prismatic", "repaired", 0.0),
    ]
    for joint_type, signs, expected in cases:
        costs = pair_costs((STATIC, MOVING), HANDLE, APPROACH, joint_type, signs)
        assert costs[vertical[0]] == pytest.approx(expected)
    tilted = pair_costs((STATIC, MOVING), HANDLE, np.array([0.0, 0.6, 0.8]), "revolute", "printed")
    assert tilted[vertical[0]] == pytest.approx(0.8 + reach)


def test_edges_apart_and_across_cost_what_they_should():
    """An x edge of one against a y edge of the other: not parallel, 0.8 at least."""
    scores = score_edge_pairs(STATIC, MOVING)
    assert scores.min() == pytest.approx(0.0)
    assert scores[0, 4] >= 0.8


def test_printed_signs_choose_the_handle_side_and_repaired_ones_the_hinge_side():
    _, printed = chosen("revolute", "printed")
    _, repaired = chosen("revolute", "repaired")
    assert printed[:, 0] == pytest.approx([0.5, 0.5])
    assert printed[:, 1] == pytest.approx([-1.5, -1.5])
    assert repaired[:, 0] == pytest.approx([-0.5, -0.5])


def test_a_hand_from_above_gives_a_drawer_the_wrong_axis():
    above, pulled = np.array([0.0, 0.0, -1.0]), np.array([0.0, -1.0, 0.0])
    _, approached = chosen("prismatic", "printed", above)
    _, moved = chosen("prismatic", "repaired", pulled)
    assert abs((approached[1] - approached[0])[2]) == pytest.approx(1.0)
    assert abs((moved[1] - moved[0])[1]) == pytest.approx(1.0)


def surface(low: tuple, high: tuple, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.uniform(low, high, (3000, 3))
    faces = rng.integers(0, 6, len(points))
    points[np.arange(len(points)), faces % 3] = np.where(
        faces < 3, np.array(low)[faces % 3], np.array(high)[faces % 3]
    )
    return points


# A body open to the front, and its door hinged at x = -0.22.
BODY = surface((-0.22, -0.14, 0), (0.22, 0.2, 0.26), 0)
DOOR = surface((-0.22, -0.17, 0), (0.22, -0.145, 0.26), 1)
PULL = np.array([0.18, -0.2, 0.13])


def test_the_joint_lies_at_the_chosen_edge():
    found, face_normal = box_joint((BODY, DOOR), PULL, APPROACH, "revolute", "repaired")
    assert np.degrees(min(angle_between(found.axis, [0, 0, s]) for s in (1, -1))) < 1
    assert np.linalg.norm((found.origin - [-0.22, -0.1425, 0])[:2]) < 0.03
    assert np.degrees(angle_between(face_normal, [0, -1, 0])) < 2
    printed, _ = box_joint((BODY, DOOR), PULL, APPROACH, "revolute", "printed")
    assert printed.origin[0] > 0.15


def test_a_part_of_a_few_points_has_no_box():
    with pytest.raises(InputError, match="5 points"):
        box_joint((BODY, DOOR[:5]), PULL, APPROACH, "revolute")
