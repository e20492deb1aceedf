"""Which Gaussians are the robot: masks drawn from the aligned model, and distance to its posed links."""

import numpy as np
from numpy.typing import NDArray

from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array
from aomgen.parts.robot_links import MAX_DISTANCE_M, nearest_links
from aomgen.parts.scan_views import ScanView, lift, spread
from aomgen.robots.configuration import RobotPosture

# Largest distance of a robot Gaussian from its links, [m]: covers cables and housings that the model omits.
LOOSE_DISTANCE_M = 0.06
# Views whose drawn robot masks vote.
VIEWS = 20


def robot_bodies(
    gaussians: Gaussians, views: list[ScanView], posture: RobotPosture, rng: np.random.Generator
) -> tuple[NDArray[np.int32], Array]:
    """Bodies (N,) of the robot's Gaussians, -1 for others, and the share of their weight inside drawn masks.

    Args:
        gaussians: The scan, world frame.
        views: Scan images with drawn robot masks.
        posture: Robot as scanned.
        rng: Spreads samples over the robot's surface.
    """
    means = np.asarray(gaussians.means, np.float64)
    near, distances = nearest_links(means, posture, rng, LOOSE_DISTANCE_M)
    inside, seen = np.zeros(len(gaussians)), np.zeros(len(gaussians))
    for view in spread(views, VIEWS):
        weights = lift(gaussians, view, [view.robot, ~view.robot])
        inside += weights[:, 0]
        seen += weights.sum(1)
    share = inside / np.maximum(seen, 1e-9)
    close = (share > 0.5) & (distances < MAX_DISTANCE_M)
    # A Gaussian on a thin finger paints well beyond the finger's outline.
    close |= (share > 0.25) & (distances < 0.5 * MAX_DISTANCE_M)
    # Rims that peep past the outline, and small Gaussians that nearly touch the model, are robot too.
    close |= (distances < 0.3 * MAX_DISTANCE_M) & (gaussians.scales.max(1) < MAX_DISTANCE_M)
    # Mirroring metal is reconstructed behind its surface: what all views see inside the robot is robot.
    behind = (share > 0.85) & (distances < LOOSE_DISTANCE_M)
    # What no view shows lies inside the robot when it is close to its surface.
    robot = (near >= 0) & np.where(seen > 0.05, close | behind, distances < 0.01)
    return np.where(robot, near, -1).astype(np.int32), share
