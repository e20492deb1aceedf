"""The video is asked about a joint: a textured panel drawn by our own engine is the video."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.core.transforms import angle_between
from aomgen.core.values import Array
from aomgen.motion.estimate import find_radius_95
from aomgen.motion.photometric import (
    choose_frames,
    compute_motion_margin,
    compute_type_margin,
    refine,
    select_frames,
)
from filmed_panel import HINGE, SHARES, SLIDE, TIMES_S, World, world

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
    assert answer is not None
    after = _errors(made, answer.joint, answer.thetas)
    assert after[0] < 0.7 * before[0]
    assert after[1] < 0.5 * before[1]
    assert after[2] < 0.4 < before[2]
    variances = np.diag(answer.covariance)
    assert after[0] < 3 * np.degrees(np.sqrt(variances[:2].sum()))
    assert after[1] < 3e3 * np.sqrt(variances[2:].sum())


def test_a_wrong_slide_is_put_right():
    made = world(SLIDE)
    hand = made.hand(np.array([0.03, -0.03]), 0.97)
    answer = refine(select_frames(made.demo, made.masks_at, hand), hand)
    assert answer is not None
    assert angle_between(answer.joint.axis, SLIDE.axis) < 0.5 * angle_between(hand.joint.axis, SLIDE.axis)
    assert np.abs(answer.thetas - made.thetas).max() < 0.002


def test_a_plain_panel_says_nothing_and_the_hand_is_kept():
    made = world(contrast=0.0)
    hand = made.hand(WRONG, 0.97)
    assert refine(select_frames(made.demo, made.masks_at, hand), hand) is None


def test_a_film_that_begins_with_the_motion_is_not_asked():
    made = world()
    hand = replace(made.hand(WRONG, 0.97), interval=(0.0, 3.0))
    assert select_frames(made.demo, made.masks_at, hand) is None
    assert refine(None, hand) is None


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


def test_the_radius_of_a_round_distribution_is_known():
    """Rayleigh: 95 % lie within sqrt(-2 ln 0.05) standard deviations."""
    assert find_radius_95(0.25 * np.eye(2)) == pytest.approx(0.5 * np.sqrt(-2 * np.log(0.05)), rel=0.03)
    assert find_radius_95(np.diag([1.0, 1e-12])) == pytest.approx(1.96, rel=0.03)


def straight(made: World) -> tuple[Joint, Array]:
    """The drawer that takes the panel's middle to where a door takes it."""
    middle = np.array([0.15, 0.0, 0.0])
    moved = made.joint.motion(made.thetas)
    ends = (moved[:, :3, :3] @ middle) + moved[:, :3, 3] - middle
    axis = ends[-1] / np.linalg.norm(ends[-1])
    return replace(SLIDE, axis=axis), ends @ axis


def turning(made: World) -> tuple[Joint, Array]:
    """A door about the panel's side that takes its middle as far as the drawer does."""
    return HINGE, -made.thetas / 0.3


def test_a_door_looks_like_a_door() -> None:
    made = world()
    seen = select_frames(made.demo, made.masks_at, made.hand(np.zeros(4), 1.0))
    door, drawer = (made.joint, made.thetas), straight(made)
    margin = compute_type_margin(seen, (door, drawer))
    assert margin > 30
    assert compute_type_margin(seen, (drawer, door)) == pytest.approx(-margin, rel=1e-9)


def test_a_drawer_looks_like_a_drawer() -> None:
    made = world(SLIDE)
    seen = select_frames(made.demo, made.masks_at, made.hand(np.zeros(2), 1.0))
    assert compute_type_margin(seen, (turning(made), (made.joint, made.thetas))) < -30


def test_the_same_answer_twice_says_nothing() -> None:
    made = world()
    answer = (made.joint, made.thetas)
    assert (
        compute_type_margin(
            select_frames(made.demo, made.masks_at, made.hand(np.zeros(4), 1.0)), (answer, answer)
        )
        == 0
    )


def test_a_bare_panel_says_nothing() -> None:
    made = world(contrast=0.0)
    seen = select_frames(made.demo, made.masks_at, made.hand(np.zeros(4), 1.0))
    assert compute_type_margin(seen, ((made.joint, made.thetas), straight(made))) == 0


def test_a_film_that_begins_with_the_motion_says_nothing() -> None:
    made = world()
    hand = replace(made.hand(np.zeros(4), 1.0), interval=(0.0, 3.0))
    seen = select_frames(made.demo, made.masks_at, hand)
    assert compute_type_margin(seen, ((made.joint, made.thetas), straight(made))) == 0


def test_a_motion_is_told_from_rest() -> None:
    moved, rested = world(), world(replace(HINGE, upper=0.0))
    hand = moved.hand(np.zeros(4), 1.0)
    answer = (moved.joint, moved.thetas)
    margins = [
        compute_motion_margin(select_frames(made.demo, made.masks_at, hand), answer)
        for made in (moved, rested)
    ]
    assert margins[0] > 30
    assert margins[1] < -30
    assert compute_motion_margin(None, answer) == 0
