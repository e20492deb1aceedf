"""The paper's motion score and threshold, held to hand-made masks; its faults are part of it."""

import numpy as np
import pytest

from aomgen.errors import InputError, NoMotionError
from aomgen.paper.mask_keyframes import (
    PartMasks,
    flag_frames,
    motion_scores,
    score_threshold,
    smooth_scores,
)


def square(corner: int, side: int, size: int = 64) -> np.ndarray:
    mask = np.zeros((size, size), bool)
    mask[corner : corner + side, corner : corner + side] = True
    return mask


def masks_of(moving: list[np.ndarray], robot: list[np.ndarray] | None = None) -> PartMasks:
    nothing = [np.zeros_like(moving[0])] * len(moving)
    return PartMasks(moving=np.stack(moving), robot=np.stack(robot or nothing))


def test_a_square_that_moves_loses_what_it_leaves():
    """From 8 x 8 at 10 to 8 x 8 at 12: 36 of 64 pixels stay."""
    assert motion_scores(masks_of([square(10, 8), square(12, 8)])) == pytest.approx([28 / 64])


def test_a_square_that_only_grows_scores_nothing_and_one_that_shrinks_does():
    small, large = square(22, 20), square(20, 24)
    assert motion_scores(masks_of([small, large]))[0] == 0.0
    assert motion_scores(masks_of([large, small])) == pytest.approx([1 - 400 / 576])


def test_the_robot_of_the_other_frame_is_taken_away():
    part, robot = square(10, 20), square(10, 10)
    hidden = part & ~robot
    assert motion_scores(masks_of([part, hidden], [np.zeros_like(part), robot])) == pytest.approx([0.0])
    assert motion_scores(masks_of([part, hidden])) == pytest.approx([100 / 400])


def test_a_part_that_is_hidden_wholly_scores_nothing():
    assert motion_scores(masks_of([square(0, 0), square(10, 8)]))[0] == 0.0


def two_levels(share: float, count: int = 300, height: float = 0.08, noise: float = 0.004) -> np.ndarray:
    scores = np.random.default_rng(3).normal(0.01, noise, count)
    moving = round(share * count)
    first = (count - moving) // 2
    scores[first : first + moving] += height
    return np.maximum(scores, 0)


@pytest.mark.parametrize("share", [0.2, 0.35, 0.5, 0.65, 0.8])
def test_the_printed_threshold_never_fires_for_usual_motions(share):
    scores = two_levels(share)
    smoothed = smooth_scores(scores)
    assert not np.any(smoothed > score_threshold(scores, smoothed, "printed"))


@pytest.mark.parametrize("share", [0.05, 0.2, 0.5, 0.75])
def test_the_repaired_threshold_finds_them(share):
    scores = two_levels(share)
    smoothed = smooth_scores(scores)
    flagged = np.flatnonzero(smoothed > score_threshold(scores, smoothed, "repaired"))
    moving = round(share * 300)
    first = (300 - moving) // 2
    assert [flagged[0], flagged[-1]] == pytest.approx([first, first + moving - 1], abs=4)


def test_the_printed_threshold_is_base_and_three_deviations_of_all_scores():
    scores = np.array([0.0] * 9 + [1.0])
    assert score_threshold(scores, scores, "printed") == pytest.approx(3 * 0.3)


def sliding(still: int, moving: int) -> list[np.ndarray]:
    corners = [10] * still + list(range(10, 10 + moving)) + [10 + moving] * still
    return [square(corner, 20) for corner in corners]


def flag_motion(moving: list[np.ndarray]) -> tuple[int, int]:
    scores = motion_scores(masks_of(moving))
    smoothed = smooth_scores(scores)
    return flag_frames(smoothed, score_threshold(scores, smoothed, "printed"))


def test_a_short_motion_is_flagged_where_it_is():
    first, last = flag_motion(sliding(90, 10))
    assert 85 <= first <= 92
    assert 97 <= last <= 104


def test_one_glitch_far_away_sets_the_end():
    moving = sliding(90, 10)
    moving[20] = square(30, 20)
    assert flag_motion(moving)[0] < 25


@pytest.mark.parametrize("moving", [[square(10, 20)] * 30, [square(10, 8 + k) for k in range(30)]])
def test_nothing_that_leaves_its_place_is_refused(moving):
    with pytest.raises(NoMotionError, match=r"threshold 0\.0000.*aomotion"):
        flag_motion(moving)


def test_one_frame_is_no_film():
    with pytest.raises(InputError, match="1 frames"):
        motion_scores(masks_of([square(10, 8)]))
