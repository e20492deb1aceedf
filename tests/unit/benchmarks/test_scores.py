"""All scores in one file: missing parts run, finished ones are kept, and two files are compared."""

import json
import subprocess
from pathlib import Path

import pytest

from aomgen.errors import ConfigError
from benchmarks import scores


def test_numbers_are_flattened_without_single_rows():
    figures = {"median": {"axis": 1.5, "ok": True}, "rows": [{"axis": 9}], "times": [1, 2], "note": "text"}
    assert dict(scores.flatten("motion", figures)) == {
        "motion.median.axis": 1.5, "motion.median.ok": 1.0, "motion.times.0": 1.0, "motion.times.1": 2.0,
    }  # fmt: skip


def test_differences_are_those_beyond_two_percent():
    rows = scores.differences({"a": 1.0, "b": 100.0, "gone": 1.0}, {"a": 1.1, "b": 101.0, "new": 2.0})
    assert [row["figure"] for row in rows] == ["a", "gone", "new"]


@pytest.fixture
def commands(monkeypatch):
    """Commands that were run; each writes the JSON that it is asked for, or fails where it is in `broken`."""

    class Commands(list):
        broken = ""

    ran = Commands()

    def run(command, check):
        ran.append(command[1:])
        failed = bool(ran.broken) and ran.broken in command
        if "--json" in command and not failed:
            Path(command[command.index("--json") + 1]).write_text(json.dumps({"value": len(ran)}))
        return subprocess.CompletedProcess(command, 1 if failed else 0)

    monkeypatch.setattr(subprocess, "run", run)
    return ran


def test_a_second_call_runs_what_is_missing(commands, tmp_path):
    figures = scores.run_scores(tmp_path, [Path("kitchen")], 9000, lambda text: None)
    assert len(commands) == 7
    assert figures["kitchen.value"] == 1
    assert "demo.seconds" in figures
    (tmp_path / "motion.json").unlink()
    scores.run_scores(tmp_path, [Path("kitchen")], 9000, lambda text: None)
    assert len(commands) == 8
    assert "--synthetic-motion" in commands[-1]
    assert json.loads((tmp_path / "scores.json").read_text())["motion.value"] == 8


def test_a_part_that_fails_is_named_and_not_taken_for_done(commands, tmp_path):
    commands.broken = "intervals"
    with pytest.raises(ConfigError, match="of the scores: ended with exit code 1"):
        scores.run_scores(tmp_path, [], 9000, lambda text: None)
    assert not (tmp_path / "intervals.json").exists()
