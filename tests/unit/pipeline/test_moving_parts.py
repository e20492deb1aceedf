"""Parts and motion in turn: they settle, and a demonstration that contradicts the prompts changes nothing."""

from dataclasses import dataclass

import numpy as np
import pytest

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.progress import silent
from aomgen.errors import NoMotionError
from aomgen.pipeline import moving_parts

PROMPTED = np.repeat(np.array([BACKGROUND, STATIC, MOVING], np.uint8), 100)


@dataclass
class Labels:
    labels: np.ndarray


@dataclass
class Scan:
    gaussians: None = None


@pytest.fixture
def world(monkeypatch):
    """Labels follow the log odds where there are some; `world.odds` is what the demonstration shows."""

    class World:
        odds: list[np.ndarray]
        rounds = 0

    made = World()

    def labelled(scan, log_odds):
        if log_odds is None:
            return Labels(PROMPTED)
        return Labels(
            np.where(log_odds > 1, MOVING, np.where(log_odds < -1, STATIC, PROMPTED)).astype(np.uint8)
        )

    def shown(demo, motion):
        made.rounds += 1
        return made.odds[min(made.rounds, len(made.odds)) - 1]

    # Evidence is what the demonstration showed.
    monkeypatch.setattr(moving_parts, "part_evidence", lambda scan, log_odds=None: log_odds)
    monkeypatch.setattr(moving_parts, "cut_scan", lambda scan, evidence, log_odds: (scan, evidence))
    monkeypatch.setattr(moving_parts, "find_parts", labelled)
    monkeypatch.setattr(moving_parts, "first_motion", lambda demo: None)
    monkeypatch.setattr(moving_parts, "compute_log_likelihood_ratio", shown)
    return made


def found() -> np.ndarray:
    scan = Scan()
    return moving_parts.find_moving_parts(scan, lambda scene, labels: Labels(labels), silent).labels  # type: ignore[arg-type]


def test_a_demonstration_that_agrees_is_asked_once(world):
    world.odds = [np.zeros(300)]
    assert np.array_equal(found(), PROMPTED)
    assert world.rounds == 1


def test_a_handle_that_was_left_out_is_taken_in_and_asked_again(world):
    odds = np.zeros(300)
    odds[180:200] = 3.0
    world.odds = [odds]
    assert np.sum(found() == MOVING) == 120
    assert world.rounds == 2


def test_a_part_that_stands_still_stays_as_prompted(world):
    """Whether it moved at all is for the motion stage to say, of labels that the prompts gave."""
    odds = np.zeros(300)
    odds[200:290] = -3.0
    world.odds = [odds]
    assert np.array_equal(found(), PROMPTED)


def test_labels_that_never_settle_end_all_the_same(world):
    first, second = np.zeros(300), np.zeros(300)
    first[150:200] = 3.0
    world.odds = [first, second, first, second]
    found()
    assert world.rounds == moving_parts.MAX_ROUNDS


def test_a_demonstration_without_motion_leaves_the_labels(world, monkeypatch):
    def refused(demo):
        raise NoMotionError("demonstration video", "shows no motion", "record it again")

    monkeypatch.setattr(moving_parts, "first_motion", refused)
    assert np.array_equal(found(), PROMPTED)
