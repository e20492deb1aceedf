"""Which type of joint the video looks like, on the made panel of the photometric tests."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.joint import Joint
from aomgen.core.values import Array
from aomgen.motion.model_selection import compute_type_margin
from aomgen.motion.photometric import select_frames
from filmed_panel import HINGE, SLIDE, World, world


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
