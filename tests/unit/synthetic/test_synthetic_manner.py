"""Manners of demonstrating: what is asked of the hand is what happens."""

from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from aomgen.assets.make import make_asset
from aomgen.core.camera import Camera
from aomgen.core.transforms import invert, rotvec_from_matrix
from aomgen.core.values import Array
from aomgen.physics.robot import RobotModel, load_robot
from aomgen.synthetic.conditions import Conditions
from aomgen.synthetic.film import draw_take, film, filmed
from aomgen.synthetic.manner import Manner, draw_manner, progress
from aomgen.synthetic.performance import Performance, perform
from aomgen.synthetic.pictures import Painter
from aomgen.synthetic.timing import CONTROL_STEP_S
from aomgen.synthetic.write import moved_range

SHORT = Conditions(size=(96, 72), fps=4)


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return load_robot("ur5e_2f85")


def hand_on_part(robot: RobotModel, performance: Performance, steps: list[int]) -> Array:
    """Poses of the hand in the frame of the moving part."""
    shown, setting = performance.demonstration, performance.setting
    Ts_world_part = setting.joint_world.motion(shown.theta[steps]) @ setting.T_world_object
    return invert(Ts_world_part) @ robot.ee_poses(shown.joints[steps])


def test_progress_is_smooth_and_minimum_jerk_without_cruise() -> None:
    u = np.linspace(0, 1, 1001)
    assert progress(u, 0.0) == pytest.approx(u**3 * (10 - 15 * u + 6 * u**2))
    assert progress(u, 1e-9) == pytest.approx(progress(u, 0.0), abs=1e-6)
    for cruise in (0.3, 0.8):
        way = progress(u, cruise)
        assert way[[0, 500, 1000]] == pytest.approx([0, 0.5, 1])
        speeds = np.diff(way) * 1000
        assert speeds.min() >= -1e-9
        assert abs(np.diff(speeds)).max() < 0.1
        assert np.ptp(speeds[400:600]) < 1e-6 or cruise < 0.2


def test_drawn_films_move_for_the_share_that_is_asked() -> None:
    asset = make_asset("microwave", 1)
    rng = np.random.default_rng(0)
    for share in (0.05, 0.4, 0.8):
        manner = draw_manner(asset, rng, moving_share=share)
        total = manner.before_s + manner.motion_s + manner.pause_s + manner.after_s - 0.6
        # The part hardly moves in the first and last moments of the motion.
        assert (manner.motion_s + manner.pause_s) / total == pytest.approx(share, rel=0.6)
        assert 0.69 < manner.follow <= 1.0
        assert np.deg2rad(20) <= manner.travel <= asset.joint.upper


def test_hand_slides_pivots_and_pauses_as_asked(robot: RobotModel) -> None:
    manner = Manner(
        travel=0.7, follow=0.75, slip_m=0.012, grip=0.15, motion_s=2.0, pause_s=1.0, before_s=3.5, after_s=1.0
    )
    asset = make_asset("microwave", 0)
    shown = perform(robot, asset, np.random.default_rng(3), manner)
    begin, end = (round(moment / CONTROL_STEP_S) for moment in shown.script.motion_s)
    Ts_part_hand = hand_on_part(robot, shown, [begin, end])
    turned = np.linalg.norm(rotvec_from_matrix(Ts_part_hand[1, :3, :3] @ Ts_part_hand[0, :3, :3].T))
    assert turned == pytest.approx(0.25 * 0.7, rel=0.2)
    slid = (Ts_part_hand[1, :3, 3] - Ts_part_hand[0, :3, 3]) @ asset.handle_axis
    assert slid == pytest.approx(0.012, abs=0.006)
    middle = shown.theta[begin + 650 : begin + 950]
    assert np.ptp(middle) < 0.03
    assert middle.mean() == pytest.approx(0.35, abs=0.05)
    assert shown.joint.axis == pytest.approx(shown.setting.joint_world.axis)


def test_film_shows_the_motion_and_nothing_else(robot: RobotModel) -> None:
    manner = Manner(travel=0.12, motion_s=4.0, cruise=0.8, before_s=0.9, after_s=0.6)
    shown = perform(robot, make_asset("drawer", 1), np.random.default_rng(1), manner)
    recorded = film(robot, shown, SHORT, np.random.default_rng(2))
    steps = recorded.take.steps
    assert len(recorded.frames) == len(recorded.labels) == len(steps)
    start, end = moved_range(shown.theta[steps], shown.joint)
    assert (end - start) / len(steps) > 0.6
    log = recorded.take.log
    assert log.times_s[0] < recorded.take.clock_offset_s
    assert (
        recorded.take.clock_offset_s + steps[-1] * CONTROL_STEP_S - steps[0] * CONTROL_STEP_S
        < log.times_s[-1]
    )


class _CountingPainter:
    """Stands in for a `Painter`: gray pictures, and how many were painted."""

    def __init__(self) -> None:
        self.painted = 0

    def draw(self, camera: object, qpos: Array) -> NDArray[np.uint8]:
        self.painted += 1
        return np.full((6, 8, 3), 100, np.uint8)

    def labels(self, camera: object, qpos: Array) -> NDArray[np.uint8]:
        return np.full((6, 8), self.painted, np.uint8)


def test_scene_at_rest_is_painted_once(robot: RobotModel) -> None:
    manner = Manner(travel=0.05, motion_s=0.5, before_s=8.0)
    shown = perform(robot, make_asset("drawer", 1), np.random.default_rng(1), manner)
    take = draw_take(robot, shown, SHORT, np.random.default_rng(2))
    painter = _CountingPainter()
    frames, labels = filmed(
        cast("Painter", painter),
        cast("Camera", None),
        shown.demonstration,
        take,
        SHORT,
        np.random.default_rng(3),
    )
    resting = [k for k in range(len(frames)) if labels[k][0, 0] == 1]
    assert len(resting) >= 12
    assert painter.painted <= len(frames) - len(resting) + 1
    assert not np.array_equal(frames[3], frames[4])
