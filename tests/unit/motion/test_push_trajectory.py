"""Parts that are pushed or hooked: the hand moves freely before it meets them and after it lets go."""

import numpy as np
import pytest

from aomgen.motion.gripper_signals import GripperSignals, TouchInterval, refine_touch
from aomgen.motion.joint_value import LEAVE_M, ValueTrajectory
from aomgen.motion.keyframes import Departures
from aomgen.motion.onset import Detectability, GripperPath
from aomgen.motion.push_trajectory import TouchObservation, follow_pushed_part

TIMES = np.arange(0.0, 8.0, 0.01, dtype=np.float64)
FRAMES = np.arange(0.0, 8.0, 0.1, dtype=np.float64)
# The hand comes by 3 cm until 1 s, waits until 2 s, pushes 10 cm until 6 s and goes back from 6.5 s.
HAND = np.interp(TIMES, [0, 1, 2, 6, 6.5, 8], [-0.03, 0, 0, 0.1, 0.1, 0.02])
PART = np.interp(FRAMES, [2, 6], [0, 0.1])


def course(
    left: np.ndarray,
    ahead: np.ndarray,
    seen_s: tuple[float, float],
    values: np.ndarray = HAND,
    aside_m: np.ndarray | None = None,
) -> ValueTrajectory:
    along, aside = (np.zeros((len(TIMES), 3)) for _ in range(2))
    along[:, 0] = values
    aside[:, 2] = 0.0 if aside_m is None else aside_m
    picture = TouchObservation(
        times_s=FRAMES, seen=Departures(left=left, ahead=ahead), sight=Detectability(noise=0.004, pixel_m=0.0)
    )
    return follow_pushed_part(TIMES, values, (along + aside, aside), seen_s, LEAVE_M, picture)


@pytest.mark.parametrize("seen_s", [(2.0, 6.0), (1.0, 8.0)])
def test_only_the_push_moves_the_part(seen_s: tuple[float, float]) -> None:
    found = course(PART * 6, 0.6 - PART * 6, seen_s)
    # 2 mm are gone after 0.08 s.
    assert found.interval == pytest.approx((2.08, 5.92), abs=0.1)
    assert found.levels == pytest.approx((0.0, 0.1), abs=0.003)
    assert np.all(np.diff(found.values) >= 0)


def test_a_shadow_that_leaves_with_the_hand_is_no_motion() -> None:
    shadow = np.interp(FRAMES, [6.5, 7.5], [0.08, 0.0])
    found = course(PART * 6, 0.6 - PART * 6 + shadow, (2.0, 7.4))
    assert found.interval[1] == pytest.approx(5.92, abs=0.15)


def test_a_hook_that_leaves_upward_and_onward_does_not_take_the_part_along() -> None:
    onward = HAND + np.interp(TIMES, [6.5, 7.0], [0.0, 0.05])
    shadow = np.interp(FRAMES, [6.5, 7.5], [0.08, 0.0])
    upward = np.interp(TIMES, [6.45, 7.0], [0.0, 0.08])
    found = course(PART * 6, 0.6 - PART * 6 + shadow, (2.0, 7.4), onward, upward)
    assert found.interval[1] == pytest.approx(5.92, abs=0.15)
    assert found.levels[1] == pytest.approx(0.1, abs=0.003)


def test_a_fist_that_slides_along_the_part_still_pushes_it() -> None:
    sliding = 0.3 * (HAND - HAND[0])
    found = course(PART * 6, 0.6 - PART * 6, (2.0, 6.0), aside_m=sliding)
    assert found.levels == pytest.approx((0.0, 0.1), abs=0.003)


def test_a_way_to_and_fro_is_longer_than_its_distance() -> None:
    times = np.arange(0.0, 3.0, 0.01, dtype=np.float64)
    points = np.zeros((300, 3))
    points[:, 0] = np.interp(times, [0, 1, 2], [0, 0.05, 0.01])
    points[:, 1] = 2e-4 * np.sin(40 * times)
    way = GripperPath(times_s=times, points=points)
    assert way.travel[-1] == pytest.approx(0.05, abs=1e-3)
    assert way.length[-1] == pytest.approx(0.09, abs=3e-3)
    assert way.length[-1] - way.length[210] < 1e-3


def test_a_touch_without_a_grip_begins_before_the_hand_is_near() -> None:
    times = np.arange(0.0, 4.0, 0.1, dtype=np.float64)
    signals = GripperSignals(
        times_s=times, Ts_world_ee=np.tile(np.eye(4), (40, 1, 1)), speeds_m_s=np.zeros(40),
        gripper=np.ones(40), distances_m=np.full(40, 0.1),
    )  # fmt: skip
    gaps = np.maximum(0.1 - 0.1 * (times - 1.0), 0.001)
    touch = refine_touch(TouchInterval(first=30, last=39, gripped=False), signals, gaps)
    # 11 mm are left at 1.89 s.
    assert times[touch.first] == pytest.approx(1.65, abs=0.1)
    assert touch.last == 39
