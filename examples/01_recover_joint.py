"""Recover a hinge from the path of the gripper that opened its door: python examples/01_recover_joint.py

The gripper holds a door by its edge and turns only partly with it, as fingers do on a handle. The path alone determines
the hinge and its uncertainty; the slip need not be known.
"""

import numpy as np

import aomgen as ag

AXIS, ORIGIN = np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.2, 0.0])  # the hinge, [m]
GRASP = np.array([0.6, -0.2, 0.3])  # where the gripper takes the door, [m]
OPENED_RAD, FOLLOWED = 1.1, 0.6  # the door turns this far; the gripper turns this share of it


def main() -> None:
    rng = np.random.default_rng(0)
    hinge = ag.Joint(type="revolute", axis=AXIS, origin=ORIGIN, lower=0.0, upper=OPENED_RAD)
    thetas = OPENED_RAD * np.linspace(0, 1, 60)
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, :3, :3] = hinge.motion(FOLLOWED * thetas)[:, :3, :3]
    held = hinge.motion(thetas) @ np.append(GRASP, 1)
    poses[:, :3, 3] = held[:, :3] + rng.normal(0, 2e-4, (60, 3))

    fit = ag.estimate_joint(poses, np.arange(60) / 10, grasp_sd_m=0.005, closing_ee=(1, 0, 0))
    off_deg = np.degrees(np.arccos(np.clip(fit.joint.axis @ AXIS, -1, 1)))
    off_mm = 1e3 * np.linalg.norm(np.cross(fit.joint.origin - ORIGIN, AXIS))
    print(f"{fit.type}: axis {off_deg:.2f} deg off, stated {np.degrees(fit.axis_radius_rad):.2f} (95 %)")
    print(f"origin {off_mm:.1f} mm off, stated {1e3 * fit.origin_radius_m:.1f} mm (95 %)")
    low, high = np.degrees(fit.theta_bounds[-1])
    print(f"opened by {np.degrees(fit.thetas[-1]):.1f} deg, stated {low:.1f} to {high:.1f} (95 %)")
    assert fit.type == "revolute"
    assert off_deg < 3
    assert off_mm < 2e3 * fit.origin_radius_m
    assert fit.theta_bounds[-1, 0] < OPENED_RAD < fit.theta_bounds[-1, 1]


if __name__ == "__main__":
    main()
