"""Points on a microwave's body and door, rotated by a known yaw."""

import numpy as np

YAW = 0.4
R = np.array([[np.cos(YAW), -np.sin(YAW), 0], [np.sin(YAW), np.cos(YAW), 0], [0, 0, 1.0]])


def box_points(low: tuple, high: tuple, seed: int = 0, count: int = 3000) -> np.ndarray:
    """Sample points on the surface of a box that is rotated by YAW."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(low, high, (count, 3))
    faces = rng.integers(0, 6, count)
    points[np.arange(count), faces % 3] = np.where(
        faces < 3, np.array(low)[faces % 3], np.array(high)[faces % 3]
    )
    return points @ R.T


# A microwave in its own frame: front towards -y, door hinged at x = -0.22.
BODY = box_points((-0.22, -0.14, 0), (0.22, 0.2, 0.26))
DOOR = box_points((-0.22, -0.17, 0.01), (0.22, -0.145, 0.25), 1)
