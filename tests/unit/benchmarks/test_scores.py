"""All scores in one file: missing parts run, finished ones are kept."""

import json
import subprocess
from pathlib import Path

import pytest
import typer

from aomgen.errors import ConfigError
from benchmarks import scores
from benchmarks.estimate_commands import scores as scores_command


def test_numbers_are_flattened_without_single_rows():
    figures = {
        "median": {"axis": 1.5, "ok": True, "worlds": 3}, "rows": [{"axis": 9}], "times": [1, 2], "note": "text",
    }  # fmt: skip
    assert dict(scores.flatten("motion", figures)) == {
        "motion.median.axis": 1.5, "motion.median.ok": 1.0, "motion.median.worlds": 3.0,
        "motion.times.0": 1.0, "motion.times.1": 2.0,
    }  # fmt: skip


@pytest.fixture
def commands(monkeypatch, tmp_path):
    """Commands that were run; each writes the JSON that it is asked for, or fails where it is in `broken`."""

    class Commands(list):
        broken = ""
        value = 10.0

    ran = Commands()

    def run(command, cwd, check):
        assert command[1:3] == ["-m", "benchmarks"]
        assert (cwd / "benchmarks" / "__main__.py").is_file()
        ran.append(command[3:])
        failed = bool(ran.broken) and ran.broken in command
        if not failed:
            Path(command[command.index("--json") + 1]).write_text(json.dumps({"axis_deg": ran.value}))
        return subprocess.CompletedProcess(command, 1 if failed else 0)

    monkeypatch.setenv("AOMGEN_BLENDER_PYTHON", str(tmp_path / "no-blender"))
    monkeypatch.setattr(subprocess, "run", run)
    return ran


def test_a_second_call_runs_what_is_missing(commands, tmp_path):
    told = []
    figures = scores.run_scores(tmp_path, [Path("kitchen")], scores.PARTS, 9000, told.append)
    assert [command[0] for command in commands] == [
        *("accuracy", "accuracy", "accuracy", "intervals", "replace", "generate", "replay", "splatting")
    ]
    assert figures["capture-kitchen.axis_deg"] == 10
    assert any("Blender is not installed" in line for line in told)
    assert "--room" not in commands[4]
    (tmp_path / "motion.json").unlink()
    scores.run_scores(tmp_path, [Path("kitchen")], scores.PARTS, 9000, told.append)
    assert len(commands) == 9
    assert "--synthetic-motion" in commands[-1]
    assert json.loads((tmp_path / "scores.json").read_text())["motion.axis_deg"] == 10


def test_three_rooms_are_traced_where_blender_is_installed(commands, monkeypatch, tmp_path):
    python = tmp_path / "python"
    python.write_text("")
    monkeypatch.setenv("AOMGEN_BLENDER_PYTHON", str(python))
    scores.run_scores(tmp_path, [], ["replace"], 9000, print)
    assert commands[0].count("--room") == 3


def test_chosen_parts_run_alone_and_unknown_ones_are_refused(commands, tmp_path):
    figures = scores.run_scores(tmp_path, [Path("kitchen")], ["intervals", "captures"], 9000, print)
    assert sorted(figures) == ["capture-kitchen.axis_deg", "intervals.axis_deg"]
    with pytest.raises(ConfigError, match=r"'interval' is unknown.*intervals"):
        scores.run_scores(tmp_path, [], ["interval"], 9000, print)


def test_a_part_that_fails_is_named_and_not_taken_for_done(commands, tmp_path):
    commands.broken = "intervals"
    with pytest.raises(ConfigError, match="of the scores: ended with exit code 1"):
        scores.run_scores(tmp_path, [], scores.PARTS, 9000, print)
    assert not (tmp_path / "intervals.json").exists()


def test_the_command_ends_with_exit_code_1_when_a_figure_is_out_of_tolerance(commands, tmp_path, capsys):
    before = tmp_path / "before.json"
    # Parts that do not run are not compared.
    before.write_text(json.dumps({"intervals.axis_deg": 10.0, "splatting.forward_ms": 1.0}))
    scores_command(tmp_path / "same", part=["intervals"], against=before)
    commands.value = 11.0
    with pytest.raises(typer.Exit) as end:
        scores_command(tmp_path / "worse", part=["intervals"], against=before)
    assert end.value.exit_code == 1
    assert "worse" in capsys.readouterr().out
