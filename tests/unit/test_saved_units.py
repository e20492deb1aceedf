"""Values of units are computed once; damaged ones are computed again."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from aomgen.core.progress import Progress, silent
from aomgen.errors import ConfigError
from aomgen.io.reuse import StoredFileWarning
from aomgen.saved_units import REQUEST_FILE, SavedUnits
from fault_run import InThisProcess


@dataclass(frozen=True, kw_only=True)
class Square:
    """The value of a unit."""

    value: int


def make(folder: Path, request: int = 1, progress: Progress = silent) -> list[int]:
    """Compute four squares, and return the units that were not kept."""
    computed = list[int]()

    def work(unit: int) -> Square:
        computed.append(unit)
        return Square(value=unit**2)

    found = SavedUnits(folder, {"request": request, "size": (1, 2)}, Square).make(
        range(4), InThisProcess(work), progress
    )
    assert [item.value for item in found] == [0, 1, 4, 9]
    return computed


def test_values_are_kept_for_one_request(tmp_path: Path) -> None:
    assert sorted(make(tmp_path / "units")) == [0, 1, 2, 3]
    assert make(tmp_path / "units") == []
    with pytest.raises(ConfigError, match="begun for something else"):
        make(tmp_path / "units", request=2)


def test_the_number_of_kept_values_is_reported(tmp_path: Path) -> None:
    texts = list[str]()
    make(tmp_path / "rollouts", progress=lambda share, text: texts.append(text))
    assert texts == ["1 of 4", "2 of 4", "3 of 4", "4 of 4"]
    (tmp_path / "rollouts" / "0001.json").unlink()
    texts.clear()
    make(tmp_path / "rollouts", progress=lambda share, text: texts.append(text))
    assert len(texts) == 2
    assert texts[0].startswith("rollouts: kept 3 of 4 of an earlier call; another")


@pytest.mark.parametrize("content", ["", '{"type": "Square", "value": {}}', '{"type": "Other"}'])
def test_a_damaged_value_is_computed_again_with_one_warning(tmp_path: Path, content: str) -> None:
    make(tmp_path / "units")
    (tmp_path / "units" / "0002.json").write_text(content)
    with pytest.warns(StoredFileWarning, match=r"0002\.json.*computed again") as warned:
        assert make(tmp_path / "units") == [2]
    assert len(warned) == 1


@pytest.mark.parametrize("content", ["", "[]", '{"request"'])
def test_values_of_a_damaged_request_are_computed_again(tmp_path: Path, content: str) -> None:
    make(tmp_path / "units")
    (tmp_path / "units" / REQUEST_FILE).write_text(content)
    with pytest.warns(StoredFileWarning, match=REQUEST_FILE) as warned:
        assert sorted(make(tmp_path / "units", request=2)) == [0, 1, 2, 3]
    assert len(warned) == 1
