"""Slip and pivot of a hand against doors and drawers made by hand."""

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.motion.ee_path import measure_slip

HELD = np.array([0.0, 0.0, 0.01])
THETAS = np.radians(np.linspace(0, 80, 9))


def door() -> Joint:
    return Joint(
        type="revolute", axis=np.array([0, 0, -1.0]), origin=np.array([0.6, 0.2, 0.0]), lower=0.0, upper=1.4
    )


def drawer() -> Joint:
    return Joint(type="prismatic", axis=np.array([-1.0, 0, 0]), origin=np.zeros(3), lower=0.0, upper=0.3)


def grasp() -> Array:
    """A hand with its point 35 cm from the hinge, looking along x."""
    R = matrix_from_rotvec([0.0, np.pi / 2, 0.0])
    return transform(R, np.array([0.6, -0.15, 0.2]) - R @ HELD)


def following(joint: Joint, thetas: Array, slips: Array, pivots: Array) -> Array:
    """Hand poses (T, 4, 4) that carry the part, slid along it (T, 3) and turned about the held point (T, 3)."""
    turned = transform(matrix_from_rotvec(pivots) @ grasp()[:3, :3], np.zeros(3))
    point = grasp()[:3, :3] @ HELD + grasp()[:3, 3]
    turned[:, :3, 3] = point + slips - turned[:, :3, :3] @ HELD
    return joint.motion(thetas) @ turned


@pytest.mark.parametrize("joint", [door(), drawer()])
def test_a_firm_grasp_neither_slides_nor_turns(joint: Joint) -> None:
    nothing = np.zeros((9, 3))
    found_slips, found_pivots = measure_slip(
        joint, THETAS, following(joint, THETAS, nothing, nothing), HELD, 0
    )
    assert np.linalg.norm(found_slips, axis=1) == pytest.approx(np.zeros(9), abs=1e-12)
    assert np.linalg.norm(found_pivots, axis=1) == pytest.approx(np.zeros(9), abs=1e-7)


@pytest.mark.parametrize("joint", [door(), drawer()])
def test_a_hand_that_slides_along_the_bar_is_seen_along_the_bar(joint: Joint) -> None:
    slips = np.outer(np.linspace(0, 0.03, 9), [0.0, 0.0, 1.0])
    found_slips, found_pivots = measure_slip(
        joint, THETAS, following(joint, THETAS, slips, np.zeros((9, 3))), HELD, 0
    )
    assert found_slips == pytest.approx(slips, abs=1e-12)
    assert np.linalg.norm(found_slips, axis=1) == pytest.approx(np.linspace(0, 0.03, 9), abs=1e-12)
    assert np.linalg.norm(found_pivots, axis=1) == pytest.approx(np.zeros(9), abs=1e-7)


def test_a_handle_that_turns_in_the_fingers_is_a_pivot_and_no_slip() -> None:
    pivots = np.outer(0.3 * THETAS, [0.0, 0.0, 1.0])
    found_slips, found_pivots = measure_slip(
        door(), THETAS, following(door(), THETAS, np.zeros((9, 3)), pivots), HELD, 0
    )
    assert np.linalg.norm(found_slips, axis=1) == pytest.approx(np.zeros(9), abs=1e-12)
    assert found_pivots == pytest.approx(pivots, abs=1e-9)


def test_a_hand_that_keeps_its_direction_pivots_by_the_whole_turn_of_the_door() -> None:
    thetas = np.radians(np.linspace(0, 200, 21))
    pivots = np.outer(thetas, [0.0, 0.0, 1.0])
    poses = following(door(), thetas, np.zeros((21, 3)), pivots)
    assert poses[:, :3, :3] == pytest.approx(np.repeat(poses[:1, :3, :3], 21, 0), abs=1e-9)
    _, found_pivots = measure_slip(door(), thetas, poses, HELD, 0)
    assert np.linalg.norm(found_pivots, axis=1) == pytest.approx(thetas, abs=1e-7)


def test_both_are_told_from_the_reference() -> None:
    slips = np.outer(np.linspace(0, 0.04, 9), [0.0, 0.0, 1.0])
    pivots = np.outer(np.radians(np.linspace(0, 240, 9)), [0.0, 0.0, 1.0])
    found_slips, found_pivots = measure_slip(
        door(), THETAS, following(door(), THETAS, slips, pivots), HELD, 4
    )
    assert np.linalg.norm(found_slips, axis=1) == pytest.approx(
        np.abs(np.linspace(-0.02, 0.02, 9)), abs=1e-12
    )
    assert np.linalg.norm(found_pivots, axis=1) == pytest.approx(
        np.radians(np.abs(np.linspace(-120, 120, 9))), abs=1e-7
    )


def test_a_turned_and_moved_world_changes_neither() -> None:
    rng = np.random.default_rng(3)
    slips, pivots = 0.01 * rng.normal(size=(9, 3)), 0.2 * rng.normal(size=(9, 3))
    poses = following(door(), THETAS, slips, pivots)
    T = transform(matrix_from_rotvec(rng.normal(size=3)), rng.normal(size=3))
    here = measure_slip(door(), THETAS, poses, HELD, 2)
    there = measure_slip(door().move(T), THETAS, T @ poses, HELD, 2)
    assert np.linalg.norm(there[0], axis=1) == pytest.approx(np.linalg.norm(here[0], axis=1), abs=1e-12)
    assert np.linalg.norm(there[1], axis=1) == pytest.approx(np.linalg.norm(here[1], axis=1), abs=1e-9)
