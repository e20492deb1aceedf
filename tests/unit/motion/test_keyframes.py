"""Start and end of a motion in small painted videos."""

import numpy as np
import pytest
from numpy.typing import NDArray

from aomgen.core.camera import Camera, look_at
from aomgen.motion.ee_path import GripperPath
from aomgen.motion.inputs import GripperSignals, TouchInterval, find_touch
from aomgen.motion.keyframes import (
    ChangeFractions,
    find_interval,
    find_part_region,
    measure_change_fractions,
)

COUNT, FPS = 90, 10.0
TIMES = np.arange(COUNT, dtype=np.float64) / FPS
DENSE = np.linspace(0.0, 8.9, 891, dtype=np.float64)
PIXEL_M = 0.005
WHOLE = TouchInterval(first=0, last=COUNT - 1, gripped=True)

# Frames, robot masks, part region.
Film = tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.bool_]]


def film(part_left: np.ndarray, *, growth: np.ndarray | None = None, seed: int = 0) -> Film:
    """A bright part on a dark table; a gray arm sweeps over it. Frames, robot masks, part region."""
    rng = np.random.default_rng(seed)
    frames = np.full((COUNT, 60, 80, 3), 60.0) + rng.normal(size=(COUNT, 60, 80, 3)) * 2
    robot = np.zeros((COUNT, 60, 80), bool)
    for k in range(COUNT):
        left = round(part_left[k])
        width = 20 + int(growth[k]) if growth is not None else 20
        frames[k, 20:40, left : left + width] += 120
        arm = int(10 * np.sin(k / 7) + 60)
        robot[k, 30:, arm : arm + 8] = True
    frames[robot] = 128
    region = np.zeros((60, 80), bool)
    region[20:40, int(part_left[0]) : int(part_left[0]) + 20] = True
    return np.clip(frames, 0, 255).astype(np.uint8), robot, region


def moves(start_s: float, end_s: float, by_px: float = 18) -> np.ndarray:
    return 22 + np.interp(TIMES, [start_s, end_s], [0, by_px])


def way(start_s: float, end_s: float, length_m: float = 0.2) -> GripperPath:
    """A hand that goes straight on from start to end."""
    points = np.zeros((len(DENSE), 3))
    points[:, 0] = np.interp(DENSE, [start_s, end_s], [0.0, length_m])
    return GripperPath(times_s=DENSE, points=points)


def found(frames: Film, hand: GripperPath) -> tuple[float, float]:
    return find_interval(measure_change_fractions(TIMES, *frames, WHOLE), hand, PIXEL_M)


@pytest.mark.parametrize(
    ("start", "end"), [(3.0, 5.0), (0.6, 8.2), (4.0, 4.3), (2.0, 2.5), (1.0, 7.0)]
)  # 3 to 85 % of the video
def test_start_and_end_are_found_for_short_and_long_motions(start: float, end: float) -> None:
    interval = found(film(moves(start, end)), way(start, end))
    pixel_s = (end - start) / 18
    assert interval == pytest.approx((start, end), abs=0.1 + pixel_s / 2)


def test_a_part_that_only_grows_is_seen() -> None:
    growth = np.interp(TIMES, [3.0, 6.0], [0, 15])
    seen = measure_change_fractions(TIMES, *film(np.full(COUNT, 22.0), growth=growth), WHOLE)
    assert seen.scores[45] > 0.1
    assert find_interval(seen, way(3.0, 6.0), PIXEL_M) == pytest.approx((3.0, 6.0), abs=0.2)


def test_the_film_backwards_gives_the_curves_exchanged() -> None:
    frames, robot, region = film(moves(3.0, 5.0))
    region = region | np.roll(region, 18, axis=1)
    forwards = measure_change_fractions(TIMES, frames, robot, region, WHOLE)
    backwards = measure_change_fractions(TIMES, frames[::-1], robot[::-1], region, WHOLE)
    assert backwards.left[::-1] == pytest.approx(forwards.ahead, abs=1e-6)
    assert backwards.scores[::-1] == pytest.approx(forwards.scores, abs=1e-6)


def test_the_film_backwards_gives_the_interval_backwards() -> None:
    frames, robot, region = film(moves(3.0, 5.0))
    region = region | np.roll(region, 18, axis=1)
    hand, last = way(3.0, 5.0), TIMES[-1]
    back = GripperPath(
        times_s=DENSE, points=np.stack([np.interp(last - DENSE, DENSE, c) for c in hand.points.T], 1)
    )
    forwards = found((frames, robot, region), hand)
    backwards = found((frames[::-1], robot[::-1], region), back)
    assert (last - backwards[1], last - backwards[0]) == pytest.approx(forwards, abs=0.02)


def test_a_pause_in_the_middle_belongs_to_the_motion() -> None:
    times, place = [3.0, 4.0, 5.5, 6.5], [0.0, 0.5, 0.5, 1.0]
    points = np.zeros((len(DENSE), 3))
    points[:, 1] = 0.2 * np.interp(DENSE, times, place)
    interval = found(
        film(22 + 18 * np.interp(TIMES, times, place)), GripperPath(times_s=DENSE, points=points)
    )
    assert interval == pytest.approx((3.0, 6.5), abs=0.1)


def test_single_bad_frames_do_not_move_the_interval() -> None:
    frames, robot, region = film(moves(4.0, 6.0))
    bad = frames.copy()
    bad[20, 15:45, 20:50] = 255
    bad[75] = frames[10]
    interval = found((bad, robot, region), way(4.0, 6.0))
    assert interval == pytest.approx((4.0, 6.0), abs=0.1)


def test_a_hand_that_slides_before_the_part_follows_does_not_start_the_motion() -> None:
    """The hand goes from 2 to 6 s, the part only from 4 s on."""
    start_s, _ = found(film(moves(4.0, 6.0)), way(2.0, 6.0, 0.4))
    assert start_s == pytest.approx(4.0, abs=0.3)


def test_the_moving_arm_alone_changes_nothing() -> None:
    assert measure_change_fractions(TIMES, *film(np.full(COUNT, 22.0)), WHOLE).scores.max() < 0.02


def test_frames_outside_the_touch_score_nothing() -> None:
    touch = TouchInterval(first=25, last=70, gripped=True)
    seen = measure_change_fractions(TIMES, *film(moves(3.0, 5.0)), touch)
    assert seen.scores[:25].max() == 0
    assert seen.scores[71:].max() == 0
    assert seen.scores[40] > 0.2


def test_noise_is_measured_about_the_smooth_course_and_not_about_the_mean() -> None:
    rng = np.random.default_rng(1)
    left = np.interp(TIMES, [2, 7], [0, 0.6]) + rng.normal(size=COUNT) * 0.004
    assert ChangeFractions(times_s=TIMES, touch=WHOLE, left=left, ahead=left[::-1]).threshold < 0.02


def signals(gripper: np.ndarray, distances: np.ndarray) -> GripperSignals:
    zeros = np.zeros(COUNT)
    return GripperSignals(
        times_s=TIMES, Ts_world_ee=np.repeat(np.eye(4)[None], COUNT, 0), speeds_m_s=zeros, gripper=gripper,
        distances_m=distances,
    )  # fmt: skip


def test_a_grip_near_the_part_bounds_the_touch_and_one_elsewhere_does_not() -> None:
    near = np.abs(TIMES - 4) * 0.2
    grip = np.where((TIMES > 3.8) & (TIMES < 7), 0.8, 0.0) + np.where(TIMES < 1, 0.8, 0.0)
    touch = find_touch(signals(grip, near))
    assert touch.gripped
    assert TIMES[[touch.first, touch.last]] == pytest.approx([3.9, 6.9], abs=0.11)
    push = find_touch(signals(np.full(COUNT, 0.8), near))
    assert not push.gripped
    assert TIMES[push.first] == pytest.approx(4.0, abs=0.11)


def test_the_parts_pixels_are_filled_between_its_points() -> None:
    camera = Camera(
        fx=100, fy=100, cx=40, cy=30, width=80, height=60, T_world_cam=look_at([0, -1, 0], [0, 0, 0])
    )
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-0.2, 0.2, 900), np.zeros(900), rng.uniform(-0.1, 0.1, 900)], 1)
    region = find_part_region(points, camera)
    assert region.sum() == pytest.approx(40 * 20, rel=0.1)


def test_a_way_to_and_fro_is_longer_than_its_distance() -> None:
    times = np.arange(0.0, 3.0, 0.01, dtype=np.float64)
    points = np.zeros((300, 3))
    points[:, 0] = np.interp(times, [0, 1, 2], [0, 0.05, 0.01])
    points[:, 1] = 2e-4 * np.sin(40 * times)
    way = GripperPath(times_s=times, points=points)
    assert way.travel[-1] == pytest.approx(0.05, abs=1e-3)
    assert way.length[-1] == pytest.approx(0.09, abs=3e-3)
    assert way.length[-1] - way.length[210] < 1e-3
