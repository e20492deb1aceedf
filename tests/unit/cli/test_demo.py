"""What `aomgen demo` downloads, and completion in a shell."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from aomgen.cli import app
from aomgen.core.project import Project
from aomgen.pipeline.stages import STAGES


@pytest.mark.parametrize("done", [False, True])
def test_weights_are_fetched_only_for_a_run_that_needs_them(tmp_path: Path, monkeypatch, done: bool):
    calls: list[str] = []

    def stage_states(project: Project, stages):
        return [(stage, "done" if done else "missing") for stage in stages]

    monkeypatch.setattr("aomgen.pipeline.runner.stage_states", stage_states)
    monkeypatch.setattr(
        "aomgen.segmentation.weights.ensure_weights", lambda name, announce: calls.append(name)
    )
    monkeypatch.setattr(app, "run_project", lambda project: calls.append("run"))
    app.demo(tmp_path)
    assert calls == (["run"] if done else ["mobile_sam", "run"])
    assert "parts" in [stage.name for stage in STAGES]


@pytest.mark.parametrize(
    ("line", "completions"), [("aomgen ex", ["export"]), ("aomgen demo --po", ["--poses"])]
)
def test_bash_completes_commands_and_options(line: str, completions: list[str]):
    program = "import sys; sys.argv = ['aomgen']; from aomgen.cli.app import main; main()"
    shell = {"_AOMGEN_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}
    printed = subprocess.check_output([sys.executable, "-c", program], env=os.environ | shell, text=True)
    assert printed.split() == completions
