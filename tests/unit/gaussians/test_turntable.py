"""The path of a turntable: around what the cameras look at, only where they have been."""

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.walk import find_target
from aomgen.gaussians.turntable import plan_turntable

TARGET = np.array([0.3, -0.2, 0.5])


def cameras(angles: np.ndarray) -> list[Camera]:
    eyes = [TARGET + [2 * np.cos(a), 2 * np.sin(a), 0.7] for a in angles]
    return [
        Camera(fx=300, fy=300, cx=160, cy=120, width=320, height=240, T_world_cam=look_at(eye, TARGET))
        for eye in eyes
    ]


def azimuths(path: list[Camera]) -> np.ndarray:
    offsets = np.array([camera.center for camera in path]) - TARGET
    return np.unwrap(np.arctan2(offsets[:, 1], offsets[:, 0]))


def test_target_is_where_the_axes_meet() -> None:
    np.testing.assert_allclose(
        find_target([camera.T_world_cam for camera in cameras(np.linspace(0, 2, 9))]), TARGET, atol=1e-6
    )


def test_scan_from_all_sides_gives_a_circle() -> None:
    path = plan_turntable(cameras(np.linspace(0, 2 * np.pi, 16, endpoint=False)), 60)
    turns = np.diff(azimuths(path))
    assert np.abs(turns) == pytest.approx(2 * np.pi / 60, rel=1e-6)
    for camera in path:
        pixels, depths = camera.project(TARGET[None])
        np.testing.assert_allclose(pixels[0], [160, 120], atol=1e-6)
        assert depths[0] == pytest.approx(np.hypot(2, 0.7))


def test_scan_from_one_side_gives_a_swing_within_it() -> None:
    angles = np.linspace(2.5, 4.5, 20)
    found = azimuths(plan_turntable(cameras(angles), 60)) % (2 * np.pi)
    assert found.min() >= 2.5
    assert found.max() <= 4.5
    assert np.ptp(found) > 1.6
    assert abs(found[0] - found[-1]) < 0.05
