"""Stated intervals are held to hidden joints."""

import numpy as np
import pytest

from benchmarks.joint_intervals import IntervalRow, interval_figures, measure_world
from benchmarks.joint_worlds import draw_world, in_part


def row(error: float, radius: float, failure: str = "") -> IntervalRow:
    return IntervalRow(
        seed=0,
        kind="prismatic",
        loose=False,
        axis=(error, radius),
        origin=(0.0, 0.0),
        values=(0.5, float(error <= radius)),
        failure=failure,
    )


def test_held_and_width_are_shares_of_the_answered() -> None:
    rows = [row(1.0, 2.0), row(1.0, 3.0), row(3.0, 2.0), row(np.inf, 0.0, "wrong type")]
    figures = interval_figures(rows)[0]
    assert (figures["worlds"], figures["failures"]) == (4, 1)
    assert figures["axis_held"] == pytest.approx(2 / 3, abs=1e-3)
    assert figures["axis_width"] == pytest.approx(2.0)
    assert figures["origin_held"] is None
    assert figures["values_held"] == pytest.approx(0.5)
    assert figures["last_value_held"] == pytest.approx(2 / 3)


def test_a_seed_is_a_world() -> None:
    assert np.array_equal(draw_world(4).Ts_world_ee, draw_world(4).Ts_world_ee)
    assert not np.array_equal(draw_world(4).joint.axis, draw_world(5).joint.axis)


@pytest.mark.slow
def test_most_intervals_hold_the_truth() -> None:
    rows = [measure_world(seed) for seed in range(8, 16)]
    assert sum(bool(item.failure) for item in rows) <= 1
    held = [item.axis[0] <= item.axis[1] and item.origin[0] <= item.origin[1] for item in rows]
    assert sum(held) >= 6
    assert np.mean([item.values[0] for item in rows if not item.failure]) > 0.85


@pytest.mark.parametrize("seed", range(6))
def test_straight_pulls_slip_along_the_pads(seed: int) -> None:
    world = draw_world(seed, "prismatic", 0.15)
    slip = in_part(world) - in_part(world)[0]
    closing = world.Ts_world_ee[0, :3, :3] @ world.closing_ee
    across = closing - (closing @ world.joint.axis) * world.joint.axis
    if np.linalg.norm(across) > 0.9:
        loosest = np.linalg.norm(np.cross(slip, world.joint.axis), axis=1).max()
        assert np.abs(slip @ across).max() < 0.002 + 0.2 * loosest
