import shutil
from pathlib import Path

import pytest

from aomgen.errors import MissingFileError
from aomgen.io.artifact import read_json
from aomgen.io.atomic import write_json
from aomgen.viewing.draw_list import DrawList
from aomgen.viewing.limit_readings import read_limits, read_rejected
from reviewed_run import commit_reviewed, make_verdict, write_reviewed_run


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return write_reviewed_run(tmp_path / "run")


def list_draws(out: Path) -> DrawList:
    return DrawList(out, out / "08_episodes")


def test_all_draws_with_the_limit_that_came_nearest(out: Path) -> None:
    draws = list_draws(out).read()
    assert [(draw.number, draw.outcome, draw.reason) for draw in draws] == [
        (0, "skipped", "out_of_view"),
        (1, "committed", "torque of the drives"),
        (2, "committed", "torque of the drives"),
        (3, "rejected", "collision"),
        (4, "committed", "torque of the drives"),
    ]
    assert draws[2].detail == "85 %, limit ≤ 90 %"
    assert [draw.room for draw in draws] == pytest.approx([16 / -85, 6 / 9, 5 / 90, -2.0, 4 / 9])
    assert draws[2].cameras == ("front", "side")
    assert draws[3].bodies == ("wrist_1_link", "table")


def test_draws_of_an_earlier_version_have_no_room_but_are_listed(out: Path) -> None:
    folder = out / "08_episodes"
    skipped, rejected = read_json(folder / "draws.json"), read_json(folder / "rejected" / "000003.json")
    del skipped["draws"][0]["excess"], rejected["excess"], rejected["bodies"]
    write_json(folder / "draws.json", skipped)
    write_json(folder / "rejected" / "000003.json", rejected)
    found = {draw.number: draw for draw in list_draws(out).read()}
    assert [(found[number].outcome, found[number].room) for number in (0, 3)] == [
        ("skipped", None),
        ("rejected", None),
    ]


def test_a_run_that_goes_on_is_read_again(out: Path) -> None:
    draws = list_draws(out)
    assert len(draws.read()) == 5
    commit_reviewed(out, 5, 0.4)
    (out / "08_episodes" / "draws.json").unlink()
    shutil.rmtree(out / "08_episodes" / "000001")
    assert [draw.number for draw in draws.read()] == [2, 3, 4, 5]
    assert draws.find(5).outcome == "committed"
    with pytest.raises(ValueError, match="there is no draw 1"):
        draws.find(1)


def test_damaged_files_are_sentences_and_the_others_stay(out: Path) -> None:
    (out / "08_episodes" / "000001" / "episode.json").write_text("{")
    (out / "08_episodes" / "rejected" / "000003.json").write_text('{"reason": "collision"}')
    found = {draw.number: draw for draw in list_draws(out).read()}
    assert [found[number].outcome for number in (1, 2, 3)] == ["damaged", "committed", "damaged"]
    assert "is not valid JSON" in found[1].detail
    assert "is not complete" in found[3].detail


def test_runs_without_episodes_have_none_and_missing_ones_are_named(tmp_path: Path) -> None:
    assert list_draws(tmp_path).read() == []
    with pytest.raises(MissingFileError, match="is missing"):
        list_draws(tmp_path / "gone").read()


def test_limits_are_ordered_by_their_room() -> None:
    found = read_limits(make_verdict(0.85).as_json())
    assert [(item.figure, item.setting) for item in found] == [
        ("torque_share", "stiff"),
        ("residual_mm", ""),
        ("target_share", "stiff"),
    ]
    assert [item.room for item in found] == pytest.approx([5 / 90, 0.9, 1.0])
    assert found[2].limit == "≥ 90.0 % of the plan"


def test_figures_of_rejections_are_words() -> None:
    found = read_rejected(
        {"penetration_mm": 3.0, "grasps_tried": 72.0, "path_share": 0.5, "torque_share": 0.95}
    )
    assert found == {
        "planned penetration of other bodies": "3.00 mm",
        "grasps tried": "72",
        "torque of the drives": "95 %",
    }
