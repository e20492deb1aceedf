import numpy as np
import pytest

from aomgen.core.gaussians import Gaussians, concatenate, gaussians_of
from aomgen.core.transforms import transform
from aomgen.twin.support import find_support

TABLE = 0.74
LEVEL = transform(np.eye(3), np.array([0.0, 0.0, TABLE]))


def flat(means: np.ndarray, size: float) -> Gaussians:
    """Level, flat Gaussians of a size, [m]."""
    count = len(means)
    return gaussians_of(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        scales=np.tile([size, size, 0.001], (count, 1)),
        opacities=np.full(count, 0.9),
        sh=np.zeros((count, 1, 3)),
    )


def sheet(rng, count: int, low, high, height: float, deviation: float, size: float) -> Gaussians:
    """Flat Gaussians with a standard deviation of their centres' heights, and the size [m] of each."""
    places = rng.uniform(low, high, (count, 2))
    return flat(np.column_stack([places, rng.normal(height, deviation, count)]), size)


def body(rng) -> Gaussians:
    return flat(rng.uniform((-0.2, -0.15, TABLE), (0.2, 0.15, TABLE + 0.3), (2000, 3)), 0.01)


@pytest.mark.parametrize("seed", range(3))
def test_a_printed_pile_beside_the_object_is_not_the_table(seed):
    rng = np.random.default_rng(seed)
    box = body(rng)
    table = sheet(rng, 1200, (-0.6, -0.6), (0.6, 0.6), TABLE, 0.004, 0.02)
    books = sheet(rng, 900, (0.25, -0.1), (0.45, 0.15), TABLE + 0.06, 0.001, 0.003)
    support = find_support(box, concatenate([table, books]), LEVEL)
    assert support.T_world_plane[2, 3] == pytest.approx(TABLE, abs=0.004)
    assert support.top == pytest.approx(0.3, abs=0.01)


def test_a_faint_tail_below_does_not_lower_the_table():
    rng = np.random.default_rng(0)
    box = body(rng)
    table = sheet(rng, 1200, (-0.6, -0.6), (0.6, 0.6), TABLE, 0.002, 0.01)
    tail = sheet(rng, 150, (-0.6, -0.6), (0.6, 0.6), TABLE - 0.04, 0.002, 0.05)
    support = find_support(box, concatenate([table, tail]), LEVEL)
    assert support.T_world_plane[2, 3] == pytest.approx(TABLE, abs=0.004)
