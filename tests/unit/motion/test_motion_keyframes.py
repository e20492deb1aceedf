"""Start and end of a motion in small painted films."""

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.errors import NoMotionError
from aomgen.motion.hand import HandSignals, Touch, touch_interval
from aomgen.motion.keyframes import KeyframeParams, find_interval, motion_scores, part_region

COUNT, FPS = 90, 10.0
TIMES = np.arange(COUNT) / FPS
WHOLE = Touch(first=0, last=COUNT - 1, gripped=True)


def film(part_left: np.ndarray, *, growth: np.ndarray | None = None, seed: int = 0) -> tuple:
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


@pytest.mark.parametrize(("start", "end"), [(3.0, 5.0), (1.0, 8.0), (4.0, 4.6)])
def test_start_and_end_are_found_for_short_and_long_motions(start: float, end: float) -> None:
    scores = motion_scores(*film(moves(start, end)), WHOLE, 3)
    interval = find_interval(TIMES, scores, WHOLE)
    assert TIMES[interval.first] == pytest.approx(start, abs=0.35)
    assert TIMES[interval.last] == pytest.approx(end, abs=0.35)


def test_a_part_that_only_grows_is_seen() -> None:
    growth = np.interp(TIMES, [3.0, 6.0], [0, 15])
    scores = motion_scores(*film(np.full(COUNT, 22.0), growth=growth), WHOLE, 3)
    interval = find_interval(TIMES, scores, WHOLE)
    assert TIMES[interval.first] == pytest.approx(3.0, abs=0.5)
    assert TIMES[interval.last] == pytest.approx(6.0, abs=0.5)


def test_the_film_backwards_gives_the_interval_backwards() -> None:
    frames, robot, region = film(moves(3.0, 5.0))
    region = region | np.roll(region, 18, axis=1)
    forwards = motion_scores(frames, robot, region, WHOLE, 3)
    backwards = motion_scores(frames[::-1], robot[::-1], region, WHOLE, 3)
    assert backwards[::-1] == pytest.approx(forwards, abs=1e-6)


def test_the_moving_arm_alone_is_no_motion() -> None:
    scores = motion_scores(*film(np.full(COUNT, 22.0)), WHOLE, 3)
    with pytest.raises(NoMotionError, match="the part does not move"):
        find_interval(TIMES, scores, WHOLE)


def test_a_single_bad_frame_does_not_open_an_interval() -> None:
    frames, robot, region = film(np.full(COUNT, 22.0))
    bad = frames.copy()
    bad[40, 15:45, 20:50] = 255
    with pytest.raises(NoMotionError):
        find_interval(TIMES, motion_scores(bad, robot, region, WHOLE, 3), WHOLE)


def test_the_noise_of_a_long_motion_does_not_raise_its_own_threshold() -> None:
    rng = np.random.default_rng(1)
    scores = np.where((TIMES > 2) & (TIMES < 7), 0.3, 0.0) + np.abs(rng.normal(size=COUNT)) * 0.004
    interval = find_interval(TIMES, scores, WHOLE)
    assert interval.threshold < 0.1
    assert TIMES[interval.first] == pytest.approx(2.0, abs=0.3)
    assert TIMES[interval.last] == pytest.approx(7.0, abs=0.3)


def test_motion_outside_the_touch_does_not_count() -> None:
    scores = np.where((TIMES > 1) & (TIMES < 2), 0.5, 0.0) + np.where((TIMES > 5) & (TIMES < 6), 0.3, 0.0)
    interval = find_interval(TIMES, scores, Touch(first=30, last=80, gripped=True), KeyframeParams())
    assert TIMES[interval.first] == pytest.approx(5.0, abs=0.3)


def test_frames_outside_the_touch_score_nothing() -> None:
    touch = Touch(first=25, last=70, gripped=True)
    scores = motion_scores(*film(moves(3.0, 5.0)), touch, 3)
    assert scores[:25].max() == 0
    assert scores[71:].max() == 0
    assert scores[40] > 0.2


def signals(gripper: np.ndarray, distances: np.ndarray) -> HandSignals:
    zeros = np.zeros(COUNT)
    return HandSignals(
        times_s=TIMES, Ts_world_ee=np.repeat(np.eye(4)[None], COUNT, 0), speeds_m_s=zeros, gripper=gripper,
        distances_m=distances,
    )  # fmt: skip


def test_a_grip_near_the_part_bounds_the_touch_and_one_elsewhere_does_not() -> None:
    near = np.abs(TIMES - 4) * 0.2
    grip = np.where((TIMES > 3.8) & (TIMES < 7), 0.8, 0.0) + np.where(TIMES < 1, 0.8, 0.0)
    touch = touch_interval(signals(grip, near))
    assert touch.gripped
    assert TIMES[[touch.first, touch.last]] == pytest.approx([3.9, 6.9], abs=0.11)
    push = touch_interval(signals(np.full(COUNT, 0.8), near))
    assert not push.gripped
    assert TIMES[push.first] == pytest.approx(4.0, abs=0.11)


def test_the_parts_pixels_are_filled_between_its_points() -> None:
    camera = Camera(
        fx=100, fy=100, cx=40, cy=30, width=80, height=60, T_world_cam=look_at([0, -1, 0], [0, 0, 0])
    )
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-0.2, 0.2, 900), np.zeros(900), rng.uniform(-0.1, 0.1, 900)], 1)
    region = part_region(points, camera)
    assert region.sum() == pytest.approx(40 * 20, rel=0.1)
