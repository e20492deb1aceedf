import numpy as np
import pytest

from aomgen.core.camera import look_at
from aomgen.core.transforms import invert, matrix_from_rotvec, transform
from aomgen.core.walk import describe_walk

TARGET = np.array([0.3, -0.2, 0.5])
ANGLES = np.radians([0, 60, 110, 170, 200, 20])


def test_walk_has_the_geometry_of_its_cameras_in_any_frame():
    eyes = [TARGET + [2 * np.cos(angle), 2 * np.sin(angle), 0.7] for angle in ANGLES]
    T_scan_world = transform(matrix_from_rotvec(np.array([0.4, -1.1, 0.3])), [3.0, 1.0, -2.0])
    walk = describe_walk([T_scan_world @ look_at(eye, TARGET) for eye in eyes])
    target_world = invert(T_scan_world) @ np.append(walk.target, 1.0)
    np.testing.assert_allclose(target_world[:3], TARGET, atol=1e-9)
    np.testing.assert_allclose(walk.axes @ walk.axes.T, np.eye(3), atol=1e-12)
    # The mean of the cameras' vertical axes is not exactly vertical.
    turns = (walk.azimuths - walk.azimuths[0]) % (2 * np.pi)
    np.testing.assert_allclose(turns, ANGLES, atol=0.1)
    gap_rad, before, after = walk.find_gap()
    assert np.degrees(gap_rad) == pytest.approx(160, abs=6)
    assert (before, after) == (4, 0)
