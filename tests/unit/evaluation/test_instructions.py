"""Selection of a demonstration by a language instruction."""

import pytest

from aomgen.evaluation.instructions import match_instruction

INSTRUCTIONS = ("open the microwave", "open the drawer", "close the drawer")


@pytest.mark.parametrize(
    ("task", "index"),
    [
        ("open the microwave", 0),
        ("Please OPEN the drawer, gently!", 1),
        ("close the drawer", 2),
        ("microwave", 0),
    ],
)
def test_the_most_similar_instruction_is_selected(task: str, index: int) -> None:
    assert match_instruction(task, INSTRUCTIONS) == index


@pytest.mark.parametrize("task", ["", "wipe a table", "the drawer"])
def test_a_task_that_suits_several_instructions_selects_none(task: str) -> None:
    assert match_instruction(task, INSTRUCTIONS) is None


def test_a_sole_instruction_is_always_selected() -> None:
    assert match_instruction("wipe a table", INSTRUCTIONS[:1]) == 0
