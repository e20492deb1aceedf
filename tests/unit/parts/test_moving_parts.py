"""Parts and motion in turn: they settle, and a demonstration that contradicts the prompts changes nothing."""

from dataclasses import dataclass

import numpy as np
import pytest

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.progress import silent
from aomgen.parts import moving_parts

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
        odds: list[np.ndarray | None]
        rounds = 0

        def shown(self, scene, labels):
            self.rounds += 1
            return self.odds[min(self.rounds, len(self.odds)) - 1]

    made = World()

    def labelled(scan, log_odds):
        if log_odds is None:
            return Labels(PROMPTED)
        return Labels(
            np.where(log_odds > 1, MOVING, np.where(log_odds < -1, STATIC, PROMPTED)).astype(np.uint8)
        )

    # Evidence is what the demonstration showed.
    monkeypatch.setattr(moving_parts, "part_evidence", lambda scan, log_odds=None: log_odds)
    monkeypatch.setattr(moving_parts, "cut_scan", lambda scan, evidence, log_odds: (scan, evidence))
    monkeypatch.setattr(moving_parts, "find_parts", labelled)
    return made


def found(world) -> np.ndarray:
    return moving_parts.find_moving_parts(Scan(), world.shown, silent).labels  # type: ignore[arg-type]


def test_a_demonstration_that_agrees_is_asked_once(world):
    world.odds = [np.zeros(300)]
    assert np.array_equal(found(world), PROMPTED)
    assert world.rounds == 1


def test_a_handle_that_was_left_out_is_taken_in_and_asked_again(world):
    odds = np.zeros(300)
    odds[180:200] = 3.0
    world.odds = [odds]
    assert np.sum(found(world) == MOVING) == 120
    assert world.rounds == 2


def test_a_part_that_stands_still_stays_as_prompted(world):
    """Whether it moved at all is for the motion stage to say, of labels that the prompts gave."""
    odds = np.zeros(300)
    odds[200:290] = -3.0
    world.odds = [odds]
    assert np.array_equal(found(world), PROMPTED)


def test_labels_that_never_settle_end_all_the_same(world):
    first, second = np.zeros(300), np.zeros(300)
    first[150:200] = 3.0
    world.odds = [first, second, first, second]
    found(world)
    assert world.rounds == moving_parts.MAX_ROUNDS


def test_a_demonstration_without_motion_leaves_the_labels(world):
    world.odds = [None]
    assert np.array_equal(found(world), PROMPTED)
    assert world.rounds == 1
