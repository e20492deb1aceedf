"""Recover a hinge from the path of the hand that opened it: python examples/02_recover_joint.py

The hand holds a door by its edge and turns only partly with it, as fingers do on a handle: where the hinge is, and how
sure that is, follows from the path alone. Slip is not known and need not be.
"""

import numpy as np

from aomgen.core.transforms import angle_between, apply, matrix_from_rotvec, transform
from aomgen.motion.ee_path import GraspGuess
from aomgen.motion.joint_estimation import estimate_joint

AXIS, ORIGIN = np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.2, 0.0])  # the hinge, m
GRASP = np.array([0.6, -0.2, 0.3])  # where the hand takes the door, m
OPENED_RAD, FOLLOWED = 1.1, 0.6  # the door turns this far; the hand turns this share of it


def main() -> None:
    rng = np.random.default_rng(0)
    thetas = OPENED_RAD * np.linspace(0, 1, 60)
    poses = []
    for theta in thetas:
        turned = matrix_from_rotvec(theta * AXIS)
        held = turned @ (GRASP - ORIGIN) + ORIGIN + rng.normal(0, 2e-4, 3)
        poses.append(transform(matrix_from_rotvec(FOLLOWED * theta * AXIS), held))
    hold = GraspGuess(point_ee=np.zeros(3), closing_ee=np.array([1.0, 0.0, 0.0]), sd_m=0.005)

    estimate = estimate_joint(np.array(poses), hold)
    joint = estimate.joint
    off_deg = np.degrees(angle_between(joint.axis, AXIS))
    at_hinge = ORIGIN + (joint.origin - ORIGIN) @ AXIS * AXIS
    off_mm = 1e3 * np.linalg.norm(joint.origin - at_hinge)
    print(f"{joint.type}: axis {off_deg:.2f} deg off, stated {np.degrees(estimate.axis_ci95_rad):.2f} (95 %)")
    print(f"origin {off_mm:.1f} mm off, stated {1e3 * estimate.origin_ci95_m:.1f} mm (95 %)")
    assert joint.type == "revolute"
    assert off_deg < 3
    assert off_mm < 2e3 * estimate.origin_ci95_m
    moved = apply(joint.motion(OPENED_RAD), GRASP)
    assert np.linalg.norm(moved - poses[-1][:3, 3]) < 0.02


if __name__ == "__main__":
    main()
