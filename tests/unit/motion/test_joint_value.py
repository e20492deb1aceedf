"""Joint values in closed form."""

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.motion.inputs import TouchInterval
from aomgen.motion.joint_value import (
    LEAVE_M,
    LEAVE_RAD,
    ValueTrajectory,
    compute_path_values,
    estimate_level_sd,
    follow_pushed_part,
    refine_interval,
    sample_at_frames,
    select_resting,
    smooth_within,
)
from aomgen.motion.keyframes import ChangeFractions

HINGE = np.array([0.6, 0.2, 0.0])
NORMAL = np.array([-1.0, 0, 0])
# The handle sits 0.31 m along the face and 0.05 m in front of it.
HANDLE = HINGE + [-0.05, -0.31, 0.22]
DOOR = Joint(type="revolute", axis=[0, 0, -1], origin=HINGE, lower=0, upper=2)
TIMES = np.arange(0.0, 8.0, 0.01, dtype=np.float64)
FRAMES = np.arange(0.0, 8.0, 0.1, dtype=np.float64)
# The hand comes by 3 cm until 1 s, waits until 2 s, pushes 10 cm until 6 s and goes back from 6.5 s.
HAND = np.interp(TIMES, [0, 1, 2, 6, 6.5, 8], [-0.03, 0, 0, 0.1, 0.1, 0.02])
PART = np.interp(FRAMES, [2, 6], [0, 0.1])


def poses_at(points: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Hands (T, 4, 4) at points with some turn about the vertical (T,)."""
    return transform(matrix_from_rotvec(turn[:, None] * np.array([0, 0, 1.0])), points)


def opened(values: np.ndarray, slide: np.ndarray) -> np.ndarray:
    """Where the handle is (T, 3), slid along the door's face by `slide` (T,)."""
    local = HANDLE + slide[:, None] * np.array([0, -1.0, 0])
    T = DOOR.motion(values)
    return np.einsum("tij,tj->ti", T[:, :3, :3], local) + T[:, :3, 3]


@pytest.mark.parametrize("turn_share", [0.0, -0.5, -1.0])
def test_the_value_does_not_depend_on_the_hands_turn(turn_share: float) -> None:
    values = np.linspace(0, 1.3, 80)
    poses = poses_at(opened(values, np.zeros(80)), turn_share * values)
    assert compute_path_values(DOOR, poses, np.zeros(3), 0) == pytest.approx(values, abs=1e-9)


@pytest.mark.parametrize("mirrored", [False, True])
def test_sliding_along_the_face_does_not_change_the_value(mirrored: bool) -> None:
    values, slide = np.linspace(0, 1.2, 60), np.linspace(0, 0.08, 60)
    flip = np.diag([1.0, -1.0, 1.0]) if mirrored else np.eye(3)
    joint = Joint(
        type="revolute", axis=DOOR.axis * (-1 if mirrored else 1), origin=flip @ HINGE, lower=0, upper=2
    )
    poses = poses_at(opened(values, slide) @ flip, np.zeros(60))
    assert compute_path_values(joint, poses, np.zeros(3), 0, NORMAL) == pytest.approx(values, abs=1e-9)


def test_a_drawers_value_is_its_travel() -> None:
    drawer = Joint(type="prismatic", axis=[0, -1, 0], origin=HANDLE, lower=0, upper=0.4)
    travel = np.linspace(0, 0.3, 40)
    points = HANDLE + travel[:, None] * np.array([0, -1.0, 0]) + [0, 0, 0.001]
    values = compute_path_values(drawer, poses_at(points, np.zeros(40)), np.zeros(3), 5)
    assert values == pytest.approx(travel - travel[5], abs=1e-12)


def moving_series() -> tuple[np.ndarray, np.ndarray]:
    times = np.arange(0, 4, 0.01)
    return times, 0.3 + np.interp(times, [1.0, 3.0], [0, 1.0])


def course(times: np.ndarray, values: np.ndarray, interval: tuple[float, float]) -> ValueTrajectory:
    return ValueTrajectory(times_s=times, values=values, interval=interval, levels=(0.3, 1.3))


def test_the_interval_is_where_the_value_has_left_and_not_arrived() -> None:
    times, values = moving_series()
    (start, end), levels = refine_interval(times, values, (1.2, 2.7), LEAVE_RAD)
    assert start == pytest.approx(1.0 + 2 * LEAVE_RAD, abs=0.02)
    assert end == pytest.approx(3.0 - 2 * LEAVE_RAD, abs=0.02)
    assert levels == pytest.approx((0.3, 1.3), abs=0.002)


def test_running_time_backwards_swaps_start_and_end() -> None:
    times, values = moving_series()
    (start, end), _ = refine_interval(times, values, (1.2, 2.7), LEAVE_RAD)
    turned = times[-1] - times[::-1]
    seen = (float(times[-1]) - 2.7, float(times[-1]) - 1.2)
    (back_start, back_end), _ = refine_interval(turned, values[::-1], seen, LEAVE_RAD)
    assert back_start == pytest.approx(times[-1] - end, abs=0.03)
    assert back_end == pytest.approx(times[-1] - start, abs=0.03)


def test_a_film_that_begins_gripped_just_before_the_motion_knows_the_first_level() -> None:
    """Held from 0.95 s on; the motion begins at 1 s."""
    times, values = moving_series()
    late = times >= 0.95
    (start, _), levels = refine_interval(times[late], values[late], (1.04, 2.7), LEAVE_RAD)
    assert start == pytest.approx(1.0 + 2 * LEAVE_RAD, abs=0.02)
    assert levels[0] == pytest.approx(0.3, abs=0.005)


def test_frames_rest_before_the_start_and_after_the_end() -> None:
    times, values = moving_series()
    frames = np.array([0.0, 0.5, 2.0, 3.5, 9.0])
    thetas = sample_at_frames(frames, course(times, values, (1.0, 3.0)), LEAVE_RAD)
    assert thetas == pytest.approx([0, 0, 0.5, 1.0, 1.0], abs=1e-6)


def test_frames_between_rest_and_leaving_show_what_the_hand_shows() -> None:
    times, values = moving_series()
    left, arrived = 1.0 + 2 * LEAVE_RAD, 3.0 - 2 * LEAVE_RAD
    frames = np.array([0.9, 1.01, arrived + 0.01, 3.1])
    thetas = sample_at_frames(frames, course(times, values, (left, arrived)), LEAVE_RAD)
    assert thetas[[0, 3]] == pytest.approx([0.0, 1.0], abs=1e-6)
    assert 0 < thetas[1] < LEAVE_RAD
    assert 1 - LEAVE_RAD < thetas[2] < 1


def test_a_hand_that_moves_much_before_the_picture_does_is_not_believed() -> None:
    times, values = moving_series()
    thetas = sample_at_frames(np.array([1.6]), course(times, values, (2.0, 3.0)), LEAVE_RAD)
    assert thetas[0] == 0.0


def test_what_rests_is_looked_at_before_it_moves() -> None:
    times = np.array([0.0, 0.6, 0.8, 0.95, 1.2])
    assert select_resting(times, np.arange(5.0), 1.0).tolist() == [1.0, 2.0]


def test_a_pull_quicker_than_the_window_is_not_smoothed_away() -> None:
    values = 0.1 * _course((0, 0), (1, 0), (1.1, 1), (2, 1))
    noisy = values + np.random.default_rng(0).normal(0, 0.0003, len(values))
    smoothed = smooth_within(noisy, 0.01, 0.2, 0.002)
    assert np.abs(smoothed - values).max() < 0.003
    assert np.std(smoothed[120:190]) < 0.0002


def _course(*corners: tuple[float, float]) -> np.ndarray:
    """Values every 0.01 s on straight lines through (time, value)."""
    moments, values = np.array(corners).T
    return np.interp(np.arange(0, moments[-1], 0.01), moments, values)


def test_a_smoothed_motion_does_not_ring_where_it_starts_pauses_and_stops() -> None:
    values = _course((0, 0), (1, 0), (1.5, 0.5), (2.5, 0.5), (3, 1), (4, 1))
    smoothed = smooth_within(values, 0.01, 0.2, LEAVE_RAD)
    assert smoothed.min() == 0.0
    assert smoothed.max() == 1.0
    np.testing.assert_array_equal(smoothed[:89], 0.0)
    np.testing.assert_array_equal(smoothed[162:238], 0.5)
    assert np.diff(smoothed).min() >= 0
    assert np.abs(smoothed - values).max() < 0.02


def test_noise_of_a_motion_one_way_is_no_motion_back() -> None:
    values = _course((0, 0), (1, 0), (2, 1), (3, 1))
    noisy = values + np.random.default_rng(0).normal(0, 0.003, len(values))
    smoothed = smooth_within(noisy, 0.01, 0.2, LEAVE_RAD)
    assert np.diff(smoothed).min() >= 0
    assert np.sqrt(np.mean((smoothed - values) ** 2)) < 0.003
    mirrored = smooth_within(-noisy, 0.01, 0.2, LEAVE_RAD)
    assert mirrored == pytest.approx(-smoothed, abs=1e-12)
    reversed_ = smooth_within(noisy[::-1], 0.01, 0.2, LEAVE_RAD)[::-1]
    assert reversed_ == pytest.approx(smoothed, abs=1e-9)


def test_a_real_motion_back_stays() -> None:
    values = _course((0, 0), (1, 1), (1.5, 0.7), (2.5, 1.2))
    smoothed = smooth_within(values, 0.01, 0.2, LEAVE_RAD)
    assert smoothed[150] < 0.75


def push_course(
    left: np.ndarray,
    ahead: np.ndarray,
    seen_s: tuple[float, float],
    values: np.ndarray = HAND,
    aside_m: np.ndarray | None = None,
) -> ValueTrajectory:
    along, aside = (np.zeros((len(TIMES), 3)) for _ in range(2))
    along[:, 0] = values
    aside[:, 2] = 0.0 if aside_m is None else aside_m
    touch = TouchInterval(first=0, last=len(FRAMES) - 1, gripped=False)
    seen = ChangeFractions(times_s=FRAMES, touch=touch, left=left, ahead=ahead)
    return follow_pushed_part(TIMES, values, (along + aside, aside), seen_s, LEAVE_M, seen)


@pytest.mark.parametrize("seen_s", [(2.0, 6.0), (1.0, 8.0)])
def test_only_the_push_moves_the_part(seen_s: tuple[float, float]) -> None:
    found = push_course(PART * 6, 0.6 - PART * 6, seen_s)
    # 2 mm are gone after 0.08 s.
    assert found.interval == pytest.approx((2.08, 5.92), abs=0.1)
    assert found.levels == pytest.approx((0.0, 0.1), abs=0.003)
    assert np.all(np.diff(found.values) >= 0)


def test_a_shadow_that_leaves_with_the_hand_is_no_motion() -> None:
    shadow = np.interp(FRAMES, [6.5, 7.5], [0.08, 0.0])
    found = push_course(PART * 6, 0.6 - PART * 6 + shadow, (2.0, 7.4))
    assert found.interval[1] == pytest.approx(5.92, abs=0.15)


def test_a_hook_that_leaves_upward_and_onward_does_not_take_the_part_along() -> None:
    onward = HAND + np.interp(TIMES, [6.5, 7.0], [0.0, 0.05])
    shadow = np.interp(FRAMES, [6.5, 7.5], [0.08, 0.0])
    upward = np.interp(TIMES, [6.45, 7.0], [0.0, 0.08])
    found = push_course(PART * 6, 0.6 - PART * 6 + shadow, (2.0, 7.4), onward, upward)
    assert found.interval[1] == pytest.approx(5.92, abs=0.15)
    assert found.levels[1] == pytest.approx(0.1, abs=0.003)


def test_a_hand_that_seems_to_leave_early_still_pushes_while_the_image_changes() -> None:
    # The first estimate of a joint is so wrong that a straight push seems to leave the part at its middle.
    late = 6 * PART * (PART / PART.max())
    aside = np.interp(TIMES, [4.4, 4.5], [0.0, 0.015])
    found = push_course(late, 0.6 - late, (2.0, 6.0), aside_m=aside)
    assert found.levels == pytest.approx((0.0, 0.1), abs=0.01)


def test_a_fist_that_slides_along_the_part_still_pushes_it() -> None:
    sliding = 0.3 * (HAND - HAND[0])
    found = push_course(PART * 6, 0.6 - PART * 6, (2.0, 6.0), aside_m=sliding)
    assert found.levels == pytest.approx((0.0, 0.1), abs=0.003)


def test_a_value_at_rest_is_uncertain_where_the_gripper_closes_as_the_motion_begins() -> None:
    values = np.interp(TIMES, [2, 6], [0, 1.0]) + 0.001 * np.sin(40 * TIMES)
    assert estimate_level_sd(TIMES, values, 2.0, LEAVE_RAD) == pytest.approx(0.001 / np.sqrt(2), rel=0.1)
    late = TIMES >= 1.85
    assert estimate_level_sd(TIMES[late], values[late], 2.0, LEAVE_RAD) == LEAVE_RAD
