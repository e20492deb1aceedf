"""True masks with a segmenter's errors: as large as said, steady where they should be."""

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from aomgen.conventions import MOVING, ROBOT
from benchmarks.motion_methods import VARIANTS, motion_methods_table
from benchmarks.segmented import MaskErrors, segmented


def labels_of(frames: int = 6, factor: int = 2) -> np.ndarray:
    """A still square of the part, half behind the robot, in images of 320 px times a factor."""
    labels = np.zeros((frames, 240 * factor, 320 * factor), np.uint8)
    labels[:, 60 * factor : 180 * factor, 100 * factor : 220 * factor] = MOVING
    labels[:, 100 * factor : 140 * factor, 180 * factor :] = ROBOT
    return labels


@pytest.mark.parametrize("factor", [1, 2])
def test_no_errors_give_the_true_masks(factor: int) -> None:
    none = MaskErrors(lasting=0, flicker=0)
    found = segmented(labels_of(factor=factor), np.random.default_rng(0), none)
    assert found.moving.shape == found.robot.shape == (6, 240, 320)
    assert np.array_equal(found.moving, labels_of(factor=1) == MOVING)
    assert np.array_equal(found.robot, labels_of(factor=1) == ROBOT)


def test_errors_are_as_large_as_said_and_mostly_last() -> None:
    """A normal error of 1 px is 0.8 px on average; from frame to frame only the flicker changes."""
    true = labels_of(factor=1)[0] == MOVING
    outline = (true & ~binary_erosion(true)).sum()
    found = segmented(labels_of(20, 1), np.random.default_rng(0), MaskErrors(lasting=1.0, flicker=0.1))
    assert (found.moving[0] ^ true).sum() / outline == pytest.approx(0.8, abs=0.25)
    changes = (found.moving[1:] ^ found.moving[:-1]).sum((1, 2)) / outline
    assert 0.02 < changes.mean() < 0.2
    assert not np.any(found.moving & found.robot)


def test_an_empty_frame_stays_empty() -> None:
    assert not segmented(np.zeros((2, 24, 32), np.uint8), np.random.default_rng(0)).moving.any()


def test_the_table_has_a_column_for_each_variant() -> None:
    figures = {"joint.axis_deg": 0.2, "images.replay_psnr": 30.0, "paper_motion.printed.joint.axis_deg": None}
    figures |= {"paper_motion.repaired.joint.axis_deg": 90.0, "paper_motion.printed.refusal": "no"}
    head, row = motion_methods_table(figures).splitlines()
    assert head.split() == ["figure", "aomotion", *VARIANTS]
    assert row.split() == ["joint.axis_deg", "0.2", "-", "-", "90"]
