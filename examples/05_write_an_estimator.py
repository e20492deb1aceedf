"""A hinge from the path of a gripper that holds its door: python examples/05_write_an_estimator.py

Estimators here are short lists of terms: residuals in their own unit, and the standard deviation of one of them. What they
weigh against each other, and how surely the answer is known, follows from that.
"""

import argparse

import numpy as np

from aomgen.core.least_squares import Kernel, ResidualTerm, add, solve
from aomgen.core.transforms import matrix_from_rotvec
from aomgen.core.values import Array

# What is believed about the path, standard deviations: noise of a position, and how far a hinge leans, [m] and [rad].
POSITION_SD_M, LEAN_SD_RAD = 0.001, 0.02


def axis_of(state: Array) -> Array:
    """Unit axis (3,) of a state (5,): its lean about x and y, a point (x, y) on it, and the radius."""
    return matrix_from_rotvec([state[0], state[1], 0.0]) @ np.array([0.0, 0.0, 1.0])


def fit_hinge(points: Array) -> tuple[Array, Array]:
    """State (5,) and its covariance (5, 5) from points (N, 3) of the held handle, [m]."""

    def offsets(state: Array) -> tuple[Array, Array]:
        """Distances (N,) from the axis, and heights (N,) along it, about their middle."""
        axis = axis_of(state)
        arms = points - np.array([state[2], state[3], points[:, 2].mean()])
        heights = arms @ axis
        return np.linalg.norm(arms - np.outer(heights, axis), axis=1), heights - heights.mean()

    # A slip of the grasp is an outlier: beyond three standard deviations it counts less and less.
    slips = Kernel(scale=3 * POSITION_SD_M, power=1.0)
    terms: list[ResidualTerm[Array]] = [
        ResidualTerm(name="circle", residual=lambda s: offsets(s)[0] - s[4], sd=POSITION_SD_M, kernel=slips),
        ResidualTerm(name="plane", residual=lambda s: offsets(s)[1], sd=POSITION_SD_M, kernel=slips),
        ResidualTerm(name="hinges are upright", residual=lambda s: s[:2], sd=LEAN_SD_RAD),
    ]
    middle = points.mean(0)
    start = np.array([0.0, 0.0, middle[0] - 0.2, middle[1], 0.3])
    found = solve(terms, start, retract=add, dimension=5)
    return found.state, found.covariance


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--degrees", type=float, default=60.0, help="How far the door turns.")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    rng = np.random.default_rng(options.seed)
    angles = np.radians(np.linspace(0, options.degrees, 60))
    hinge, radius = np.array([0.6, 0.2]), 0.35
    circle = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.zeros(60)], 1)
    points = circle + [*hinge, 0.4] + rng.normal(0, POSITION_SD_M, (60, 3))
    points[::15] += rng.normal(0, 0.02, (4, 3))  # the hand slips

    state, covariance = fit_hinge(points)
    sd = np.sqrt(np.diag(covariance))
    off_mm, off_sd_mm = 1e3 * np.linalg.norm(state[2:4] - hinge), 1e3 * np.linalg.norm(sd[2:4])
    lean_deg = np.degrees(np.arccos(np.clip(axis_of(state)[2], -1, 1)))
    lean_sd_deg = np.degrees(np.linalg.norm(sd[:2]))
    print(f"hinge {off_mm:.1f} mm off (standard deviation {off_sd_mm:.1f} mm)")
    print(f"axis {lean_deg:.1f} deg off (standard deviation {lean_sd_deg:.1f} deg)")
    assert off_mm < 3 * off_sd_mm
    assert lean_deg < 3 * lean_sd_deg


if __name__ == "__main__":
    main()
