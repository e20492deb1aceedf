"""What the hand says about the joint as a prior for the video."""

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.motion.photometric_estimate import compute_line_covariance, find_radius_95
from aomgen.motion.photometric_residuals import shift_joint


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


def test_the_radius_of_a_round_distribution_is_known():
    """Rayleigh: 95 % lie within sqrt(-2 ln 0.05) standard deviations."""
    assert find_radius_95(0.25 * np.eye(2)) == pytest.approx(0.5 * np.sqrt(-2 * np.log(0.05)), rel=0.03)
    assert find_radius_95(np.diag([1.0, 1e-12])) == pytest.approx(1.96, rel=0.03)
