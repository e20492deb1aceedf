"""What the gripper's path says about the joint as a prior for the video."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.motion.kinematic_prior import compute_line_covariance, shift_joint
from filmed_panel import HELD, HINGE, SHARES, world


@pytest.mark.parametrize("joint_type", ["revolute", "prismatic"])
def test_axes_drawn_about_a_joint_have_the_covariance_they_were_drawn_with(joint_type):
    joint = Joint(
        type=joint_type, axis=np.array([0.6, 0, 0.8]), origin=np.array([1.0, 2, 3]), lower=0, upper=1
    )
    sds = np.array([0.01, 0.02, 0.003, 0.001])
    numbers = np.random.default_rng(1).normal(0, 1, (4000, 4)) * sds
    drawn = [shift_joint(joint, joint.origin, x) for x in numbers]
    # Any point of an axis will do.
    axes = np.array([item.axis for item in drawn])
    points = np.array([item.origin for item in drawn]) + 0.3 * axes
    found = compute_line_covariance(joint, joint.origin, (axes, points))
    count = 4 if joint_type == "revolute" else 2
    assert found.shape == (count, count)
    assert np.sqrt(np.diag(found)) == pytest.approx(sds[:count], rel=0.05)


def test_the_lever_is_what_the_held_points_say_about_a_moved_axis():
    """A hinge moved towards the hand by d at a quarter turn: the angle grows by d / r, seen from there."""
    hand = replace(world().hand(np.zeros(4), 1.0), thetas=SHARES * np.pi / 2, interval=(0.0, 3.5))
    lever = hand.value_lever()
    x = np.zeros(4)
    x[2] = 1e-4
    moved = shift_joint(HINGE, np.zeros(3), x)
    turned = np.array([0.0, 0.3, 0.0]) - moved.origin
    first = HELD - moved.origin
    expected = np.arctan2(np.cross(first, turned)[2], first @ turned) - np.pi / 2
    assert lever[-1, 2] * 1e-4 == pytest.approx(expected, abs=1e-8)
    assert abs(expected) == pytest.approx(1e-4 / 0.3, rel=1e-3)
    assert not lever[:, :2].any()
