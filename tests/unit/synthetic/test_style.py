"""Manners of demonstrating: what is asked of the hand is what happens."""

from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from aomgen.assets.choice import make_asset
from aomgen.core.camera import Camera
from aomgen.core.motion import Direction
from aomgen.core.transforms import invert, rotvec_from_matrix
from aomgen.core.values import Array
from aomgen.errors import ConfigError
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene_renderer import SceneRenderer
from synthetic.commanded_trajectory import CONTROL_STEP_S
from synthetic.demonstration_search import Performance, find_demonstration
from synthetic.scene_recording import Conditions, draw_schedule, render_frames
from synthetic.style import (
    DemonstrationStyle,
    GraspType,
    Outcome,
    compute_progress,
    draw_style,
)
from synthetic.world import draw_capture_style, find_moved_range

SHORT = Conditions(size=(96, 72), fps=4)


def hand_on_part(robot: RobotModel, performance: Performance, steps: list[int]) -> Array:
    """Poses of the hand in the frame of the moving part."""
    shown, layout = performance.demonstration, performance.layout
    Ts_world_part = layout.joint_world.motion(shown.theta[steps]) @ layout.T_world_object
    return invert(Ts_world_part) @ robot.ee_poses(shown.joints[steps])


def test_progress_is_smooth_and_minimum_jerk_without_cruise() -> None:
    u = np.linspace(0, 1, 1001)
    assert compute_progress(u, 0.0) == pytest.approx(u**3 * (10 - 15 * u + 6 * u**2))
    assert compute_progress(u, 1e-9) == pytest.approx(compute_progress(u, 0.0), abs=1e-6)
    for cruise in (0.3, 0.8):
        way = compute_progress(u, cruise)
        assert way[[0, 500, 1000]] == pytest.approx([0, 0.5, 1])
        speeds = np.diff(way) * 1000
        assert speeds.min() >= -1e-9
        assert abs(np.diff(speeds)).max() < 0.1
        assert np.ptp(speeds[400:600]) < 1e-6 or cruise < 0.2


def test_drawn_films_move_for_the_share_that_is_asked() -> None:
    asset = make_asset("microwave", 1)
    rng = np.random.default_rng(0)
    for share in (0.05, 0.4, 0.8):
        style = draw_style(asset, rng, moving_share=share)
        total = style.before_s + style.motion_s + style.pause_s + style.after_s - 0.6
        # The part hardly moves in the first and last moments of the motion.
        assert (style.motion_s + style.pause_s) / total == pytest.approx(share, rel=0.6)
        assert 0.69 < style.follow <= 1.0
        assert np.deg2rad(20) <= style.travel <= asset.joint.upper


def test_hand_slides_pivots_and_pauses_as_asked(robot: RobotModel) -> None:
    style = DemonstrationStyle(
        travel=0.7, follow=0.75, slip_m=0.012, grip=0.15, motion_s=2.0, pause_s=1.0, before_s=3.5, after_s=1.0
    )
    asset = make_asset("microwave", 0)
    shown = find_demonstration(robot, asset, np.random.default_rng(3), style)
    begin, end = (round(moment / CONTROL_STEP_S) for moment in shown.script.motion_s)
    Ts_part_hand = hand_on_part(robot, shown, [begin, end])
    turned = np.linalg.norm(rotvec_from_matrix(Ts_part_hand[1, :3, :3] @ Ts_part_hand[0, :3, :3].T))
    assert turned == pytest.approx(0.25 * 0.7, rel=0.2)
    slid = (Ts_part_hand[1, :3, 3] - Ts_part_hand[0, :3, 3]) @ asset.handle_axis
    assert slid == pytest.approx(0.012, abs=0.006)
    middle = shown.theta[begin + 650 : begin + 950]
    assert np.ptp(middle) < 0.03
    assert middle.mean() == pytest.approx(0.35, abs=0.05)
    assert shown.joint.axis == pytest.approx(shown.layout.joint_world.axis)


def test_film_shows_the_motion_and_nothing_else(robot: RobotModel) -> None:
    style = DemonstrationStyle(travel=0.12, motion_s=4.0, cruise=0.8, before_s=0.9, after_s=0.6)
    shown = find_demonstration(robot, make_asset("drawer", 1), np.random.default_rng(1), style)
    schedule = draw_schedule(robot, shown, SHORT, np.random.default_rng(2))
    start, end = find_moved_range(shown.theta[schedule.steps], shown.joint)
    assert start is not None
    assert end is not None
    assert (end - start) / len(schedule.steps) > 0.6
    log = schedule.log
    assert log.times_s[0] < schedule.clock_offset_s
    seconds = (schedule.steps[-1] - schedule.steps[0]) * CONTROL_STEP_S
    assert schedule.clock_offset_s + seconds < log.times_s[-1]


class _CountingPainter:
    """Stands in for a `SceneRenderer`: gray pictures, and how many were painted."""

    def __init__(self) -> None:
        self.painted = 0

    def draw(self, camera: object, qpos: Array) -> NDArray[np.uint8]:
        self.painted += 1
        return np.full((6, 8, 3), 100, np.uint8)

    def labels(self, camera: object, qpos: Array) -> NDArray[np.uint8]:
        return np.full((6, 8), self.painted, np.uint8)


def test_scene_at_rest_is_painted_once(robot: RobotModel) -> None:
    style = DemonstrationStyle(travel=0.05, motion_s=0.5, before_s=8.0)
    shown = find_demonstration(robot, make_asset("drawer", 1), np.random.default_rng(1), style)
    schedule = draw_schedule(robot, shown, SHORT, np.random.default_rng(2))
    painter = _CountingPainter()
    frames, labels = render_frames(
        cast("SceneRenderer", painter),
        cast("Camera", None),
        shown.demonstration,
        schedule,
        SHORT,
        np.random.default_rng(3),
    )
    resting = [k for k in range(len(frames)) if labels[k][0, 0] == 1]
    assert len(resting) >= 12
    assert painter.painted <= len(frames) - len(resting) + 1
    assert not np.array_equal(frames[3], frames[4])


def assert_honest(performance: Performance) -> None:
    """The part moves only while something touches it (or coasts after), and the arm hits nothing else."""
    shown = performance.demonstration
    touched = np.array([len(touches) > 0 for touches in shown.contacts])
    first = int(np.argmax(touched)) if touched.any() else len(touched)
    assert np.abs(performance.theta[:first]).max() < 0.01 * performance.style.travel
    assert not shown.foreign


@pytest.mark.parametrize(
    ("category", "touch", "direction"),
    [
        ("drawer", "hook", "opening"),
        ("drawer", "push", "closing"),
        ("drawer", "pinch", "closing"),
        ("cabinet", "push", "opening"),
    ],
)
def test_hand_moves_the_part_in_every_manner(
    robot: RobotModel, category: str, touch: GraspType, direction: Direction
) -> None:
    start = 0.15 if direction == "closing" else 0.0
    style = DemonstrationStyle(travel=0.12, touch=touch, direction=direction, start=start, motion_s=1.5)
    shown = find_demonstration(robot, make_asset(category, 1), np.random.default_rng(1), style)
    assert_honest(shown)
    assert shown.theta[-1] == pytest.approx(0.12, abs=0.03)
    begin = round(shown.script.motion_s[0] / CONTROL_STEP_S)
    sides = {c.finger for touches in shown.demonstration.contacts[begin + 300 : begin + 600] for c in touches}
    assert sides
    # Only a pinch presses from both sides of the bar.
    normals = np.array([c.normal for c in shown.demonstration.contacts[begin + 400] if c.force > 1.0])
    if len(normals):
        opposed = (normals @ normals.T).min() < -0.5
        assert opposed == (touch == "pinch")


def test_closing_is_told_from_the_scanned_state_in_the_demonstrated_direction(robot: RobotModel) -> None:
    style = DemonstrationStyle(travel=0.12, direction="closing", start=0.15, motion_s=1.0)
    shown = find_demonstration(robot, make_asset("drawer", 1), np.random.default_rng(1), style)
    joint, opening = shown.joint, shown.layout.joint_world
    assert joint.axis == pytest.approx(-opening.axis)
    assert (joint.lower, joint.upper) == pytest.approx((0.15 - opening.upper, 0.15))
    assert shown.theta[0] == pytest.approx(0.0, abs=1e-4)
    T_scanned = opening.motion(0.15) @ shown.layout.T_world_object
    T_world_part = opening.motion(shown.demonstration.theta) @ shown.layout.T_world_object
    assert joint.motion(shown.theta) @ T_scanned == pytest.approx(T_world_part, abs=1e-9)


@pytest.mark.parametrize("outcome", ["nothing", "touch", "locked"])
def test_part_stays_where_nothing_can_be_learned(robot: RobotModel, outcome: Outcome) -> None:
    style = DemonstrationStyle(travel=0.1, outcome=outcome, motion_s=1.0)
    shown = find_demonstration(robot, make_asset("drawer", 1), np.random.default_rng(1), style)
    assert np.abs(shown.theta).max() < 0.001
    assert find_moved_range(shown.theta, shown.joint) == (None, None)
    forces = [c.force for touches in shown.demonstration.contacts for c in touches]
    if outcome == "nothing":
        assert not forces
    else:
        assert max(forces) > 5.0


def test_cut_film_ends_before_the_motion_and_the_log_goes_on(robot: RobotModel) -> None:
    style = DemonstrationStyle(travel=0.1, outcome="cut", motion_s=1.0)
    shown = find_demonstration(robot, make_asset("drawer", 1), np.random.default_rng(1), style)
    schedule = draw_schedule(robot, shown, SHORT, np.random.default_rng(2))
    assert schedule.steps[-1] * CONTROL_STEP_S < shown.script.motion_s[0]
    assert find_moved_range(shown.theta[schedule.steps], shown.joint) == (None, None)
    assert schedule.log.times_s[-1] - schedule.log.times_s[0] == pytest.approx(
        shown.script.times_s[-1], abs=0.02
    )


def test_impossible_touch_is_refused_at_once(robot: RobotModel) -> None:
    with pytest.raises(ConfigError, match=r"drawer-1.*push when opening.*pinch or hook"):
        find_demonstration(
            robot,
            make_asset("drawer", 1),
            np.random.default_rng(1),
            DemonstrationStyle(travel=0.1, touch="push"),
        )


def test_captures_in_a_manner_begin_and_end_at_rest() -> None:
    assert draw_capture_style("drawer", 1, "opening", "pinch") is None
    style = draw_capture_style("drawer", 1, "closing", "push")
    assert style is not None
    assert style.before_s >= 4.5
    assert 0.05 <= style.travel <= style.start
    with pytest.raises(
        ConfigError, match=r"'hook' is none that a cabinet allows when opening; choose pinch or push"
    ):
        draw_capture_style("cabinet", 1, "opening", "hook")
