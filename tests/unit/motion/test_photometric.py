"""The video is asked about a joint: a textured panel drawn by our own engine is the video."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.core.transforms import angle_between
from aomgen.core.values import Array
from aomgen.motion.photometric import choose_frames, refine, select_frames
from aomgen.motion.photometric_residuals import shift_joint
from aomgen.motion.photometric_solver import compute_value_lever
from filmed_panel import HELD, HINGE, SHARES, SLIDE, TIMES_S, World, world

WRONG = np.array([0.02, -0.02, 0.006, -0.006])


def _errors(made: World, joint: Joint, thetas: Array) -> tuple[float, float, float]:
    """Axis [deg], origin [mm], values [deg]."""
    offset = joint.origin - made.joint.origin
    across = offset - (offset @ made.joint.axis) * made.joint.axis
    return (
        float(np.degrees(angle_between(joint.axis, made.joint.axis))),
        1e3 * float(np.linalg.norm(across)),
        float(np.degrees(np.sqrt(np.mean((thetas - made.thetas) ** 2)))),
    )


@pytest.mark.parametrize("arm", [False, True])
def test_a_wrong_hinge_is_put_right_whatever_the_exposure_and_the_arm(arm):
    made = world(gains=1 - 0.2 * SHARES, arm=arm)
    hand = made.hand(WRONG, 0.97)
    before = _errors(made, hand.joint, hand.thetas)
    answer = refine(select_frames(made.demo, made.masks_at, hand), hand)
    after = _errors(made, answer.joint, answer.thetas)
    assert answer.accepted, answer.reason
    assert answer.evidence is not None
    assert answer.evidence.cost_after < answer.evidence.cost_before
    assert after[0] < 0.7 * before[0]
    assert after[1] < 0.5 * before[1]
    assert after[2] < 0.4 < before[2]
    assert after[0] < 3 * np.degrees(answer.axis_sd_rad)
    assert after[1] < 3e3 * answer.origin_sd_m


def test_a_wrong_slide_is_put_right():
    made = world(SLIDE)
    hand = made.hand(np.array([0.03, -0.03]), 0.97)
    answer = refine(select_frames(made.demo, made.masks_at, hand), hand)
    assert answer.accepted, answer.reason
    assert angle_between(answer.joint.axis, SLIDE.axis) < 0.5 * angle_between(hand.joint.axis, SLIDE.axis)
    assert np.abs(answer.thetas - made.thetas).max() < 0.002


def test_a_plain_panel_says_nothing_and_the_hand_is_kept():
    made = world(contrast=0.0)
    hand = made.hand(WRONG, 0.97)
    answer = refine(select_frames(made.demo, made.masks_at, hand), hand)
    assert not answer.accepted
    assert answer.reason
    assert answer.joint == hand.joint
    np.testing.assert_array_equal(answer.thetas, hand.thetas)


def test_a_film_that_begins_with_the_motion_is_not_asked():
    made = world()
    hand = replace(made.hand(WRONG, 0.97), interval=(0.0, 3.0))
    answer = refine(select_frames(made.demo, made.masks_at, hand), hand)
    assert not answer.accepted
    assert "before" in answer.reason


def test_the_lever_is_what_the_held_points_say_about_a_moved_axis():
    """A hinge moved towards the hand by d at a quarter turn: the angle grows by d / r, seen from there."""
    hand = replace(world().hand(np.zeros(4), 1.0), thetas=SHARES * np.pi / 2, interval=(0.0, 3.5))
    lever = compute_value_lever(hand, np.zeros(3))
    x = np.zeros(4)
    x[2] = 1e-4
    moved = shift_joint(HINGE, np.zeros(3), x)
    turned = np.array([0.0, 0.3, 0.0]) - moved.origin
    first = HELD - moved.origin
    expected = np.arctan2(np.cross(first, turned)[2], first @ turned) - np.pi / 2
    assert lever[-1, 2] * 1e-4 == pytest.approx(expected, abs=1e-8)
    assert abs(expected) == pytest.approx(1e-4 / 0.3, rel=1e-3)


def test_a_quick_motion_is_also_seen_after_it():
    made = world()
    quick = replace(
        made.hand(np.zeros(4), 1.0), interval=(0.8, 1.0), thetas=np.clip((TIMES_S - 0.8) / 0.2, 0, 1)
    )
    fitted, held_out, resting = choose_frames(quick, 4)
    assert len(fitted) == len(held_out) == 4
    assert TIMES_S[resting].max() < 0.75
    assert TIMES_S[np.concatenate([fitted, held_out])].max() > 3
    assert not set(fitted) & set(held_out)
    slow = choose_frames(made.hand(np.zeros(4), 1.0), 4)
    assert TIMES_S[np.concatenate(slow[:2])].max() <= 3.0


def test_a_motion_that_takes_no_time_is_not_asked_about():
    still = replace(world().hand(np.zeros(4), 1.0), interval=(1.0, 1.0))
    assert not len(choose_frames(still, 4)[0])
