"""When the hand can move the part, from grip and distance alone."""

import numpy as np
import pytest

from aomgen.core.values import Array
from aomgen.motion.inputs import GripperSignals, TouchInterval, find_touch, refine_touch

TIMES = np.arange(100) / 10


def signals(gripper: Array, distances: Array) -> GripperSignals:
    count = len(TIMES)
    return GripperSignals(
        times_s=TIMES, Ts_world_ee=np.repeat(np.eye(4)[None], count, 0), speeds_m_s=np.zeros(count),
        gripper=gripper, distances_m=distances,
    )  # fmt: skip


def arriving(at_s: float, leaving_s: float = 99.0) -> Array:
    """Distances of fingers that come, stay and go, [m]."""
    return 0.004 + 0.2 * (np.maximum(at_s - TIMES, 0) + np.maximum(TIMES - leaving_s, 0))


def grip(on_s: float, off_s: float, value: float) -> Array:
    return np.where((on_s < TIMES) & (off_s > TIMES), value, 0.0)


def test_a_hand_that_does_not_let_go_holds_to_the_end() -> None:
    touch = find_touch(signals(grip(3.05, 99, 0.8), arriving(3.0)))
    assert touch.gripped
    assert TIMES[touch.first] == pytest.approx(3.1)
    assert touch.last == 99


def test_a_hand_that_holds_from_the_beginning_lets_go() -> None:
    touch = find_touch(signals(grip(-1, 6.05, 0.8), arriving(-1.0, 6.0)))
    assert (touch.gripped, touch.first, TIMES[touch.last]) == (True, 0, pytest.approx(6.0))


def test_a_fist_near_the_part_does_not_grip_it() -> None:
    """The hand closes upon itself half a second before it comes to push."""
    touch = find_touch(signals(grip(2.05, 99, 0.98), arriving(2.5)))
    assert not touch.gripped
    assert TIMES[touch.first] == pytest.approx(2.5, abs=0.11)
    assert touch.last == 99


def test_a_hand_that_never_closes_touches_where_it_is_near() -> None:
    touch = find_touch(signals(np.zeros(100), arriving(4.0)))
    assert not touch.gripped
    assert TIMES[touch.first] == pytest.approx(4.0, abs=0.11)


def test_a_grasp_of_the_part_counts_and_one_elsewhere_does_not() -> None:
    both = grip(1.05, 2.05, 0.6) + grip(5.05, 8.05, 0.8)
    touch = find_touch(signals(both, arriving(5.0)))
    assert TIMES[[touch.first, touch.last]] == pytest.approx([5.1, 8.0])
    far = find_touch(signals(grip(1.05, 2.05, 0.6), arriving(5.0)))
    assert not far.gripped


def test_a_touch_without_a_grip_begins_before_the_hand_is_near() -> None:
    times = np.arange(0.0, 4.0, 0.1, dtype=np.float64)
    gaps = np.maximum(0.1 - 0.1 * (times - 1.0), 0.001)
    touch = refine_touch(TouchInterval(first=30, last=39, gripped=False), times, gaps)
    # 11 mm are left at 1.89 s.
    assert times[touch.first] == pytest.approx(1.65, abs=0.1)
    assert touch.last == 39
