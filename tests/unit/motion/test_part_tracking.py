"""Each Gaussian is asked whether it moved: the panel did, the wall behind it did not."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.conventions import BACKGROUND, MOVING
from aomgen.core.values import Array
from aomgen.motion.part_tracking import track_log_likelihood_ratio
from filmed_panel import HINGE, MOTION_S, SHARES, SLIDE, World, world


def odds(made: World, labels: Array | None = None) -> Array:
    demo = made.demo if labels is None else replace(made.demo, labels=labels)
    return track_log_likelihood_ratio(demo, made.joint, made.thetas, MOTION_S[0], made.masks_at)


@pytest.mark.parametrize("joint", [HINGE, SLIDE])
@pytest.mark.parametrize("arm", [False, True])
def test_what_moved_is_told_from_what_stood(joint, arm):
    made = world(joint, arm=arm)
    found, moves = odds(made), made.demo.labels == MOVING
    told = np.abs(found) > 1
    assert np.mean(told[moves]) > 0.15
    assert np.mean(found[told & moves] > 0) > 0.85
    assert np.mean(found[~moves] > 1) < 0.02


def test_wrong_labels_are_contradicted():
    """A fifth of the panel was taken for the wall, a fifth of the wall for the panel."""
    made = world()
    moves = made.demo.labels == MOVING
    wrong = np.where(np.arange(len(moves)) % 5 > 0, made.demo.labels, np.where(moves, BACKGROUND, MOVING))
    found = odds(made, wrong.astype(np.uint8))
    told = np.abs(found) > 1
    assert np.mean(found[told & moves] > 0) > 0.7
    assert np.mean(found[~moves] > 1) < 0.02


def test_changing_light_on_the_part_is_no_sign_of_standing_still():
    made = world(gains=1 - 0.3 * SHARES)
    found, moves = odds(made), made.demo.labels == MOVING
    told = moves & (np.abs(found) > 1)
    assert np.mean(found[told] > 0) > 0.85


def test_a_plain_panel_says_little():
    made = world(contrast=0.0)
    moves = made.demo.labels == MOVING
    assert np.mean(odds(made)[moves] < -1) < 0.02


def test_a_video_that_begins_with_the_motion_says_nothing():
    made = world()
    assert not track_log_likelihood_ratio(made.demo, made.joint, made.thetas, 0.0, made.masks_at).any()
