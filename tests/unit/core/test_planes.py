"""The plane among strays is found, and only one that the axis allows."""

import numpy as np
import pytest

from aomgen.core.boxes import fit_plane
from aomgen.core.transforms import matrix_from_rotvec


def walls(rng: np.random.Generator) -> np.ndarray:
    """A large wall, a smaller floor, and strays, (N, 3)."""
    wall = np.insert(rng.uniform(-1, 1, (900, 2)), 0, 1.0, axis=1)
    floor = np.insert(rng.uniform(-1, 1, (500, 2)), 2, -0.5, axis=1)
    return np.concatenate([wall, floor]) + rng.normal(0, 0.003, (1400, 3))


@pytest.mark.parametrize("copies", [1, 8])
def test_the_largest_plane_is_found_in_any_frame(copies):
    rng = np.random.default_rng(0)
    points = np.concatenate([*[walls(rng) for _ in range(copies)], rng.uniform(-1, 1, (600, 3))])
    R = matrix_from_rotvec([0.4, -1.0, 0.3])
    found = fit_plane(points @ R.T, 0.01, rng, 300)
    assert found is not None
    normal, center = found
    assert abs(normal @ R[:, 0]) == pytest.approx(1.0, abs=1e-4)
    assert abs(center @ R[:, 0]) == pytest.approx(1.0, abs=0.002)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_axis_chooses_the_floor_and_its_side(sign):
    rng = np.random.default_rng(1)
    up = np.array([0.0, 0.1, sign]) / np.hypot(0.1, 1.0)
    found = fit_plane(walls(rng), 0.01, rng, 300, axis=up, max_tilt_deg=30.0)
    assert found is not None
    assert found[0] == pytest.approx([0, 0, sign], abs=0.005)
    assert found[1][2] == pytest.approx(-0.5, abs=0.002)


def test_no_plane_is_none():
    rng = np.random.default_rng(2)
    assert fit_plane(np.zeros((50, 3)), 0.01, rng, 100) is None
    level = np.insert(rng.uniform(-1, 1, (100, 2)), 2, 0.0, axis=1)
    assert fit_plane(level, 0.01, rng, 100, axis=np.array([1.0, 0, 0]), max_tilt_deg=30.0) is None
