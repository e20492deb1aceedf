"""Selection of a demonstration by a language instruction."""

import re
from collections.abc import Sequence


def match_instruction(task: str, instructions: Sequence[str]) -> int | None:
    """Find the instruction that has the most words in common with a task.

    Words are compared without case and punctuation; a sole instruction is always selected.

    Returns:
        Index of the instruction; None if several instructions have the same largest number of common words.

    Example:
        >>> match_instruction("Please open the drawer.", ["open the microwave", "open the drawer"])
        1
    """
    common = [len(_list_words(task) & _list_words(instruction)) for instruction in instructions]
    best = max(common)
    return common.index(best) if common.count(best) == 1 else None


def _list_words(text: str) -> set[str]:
    return set(re.findall(r"\w+", text.lower()))
