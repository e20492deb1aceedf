"""The generation yields episodes of its own request only."""

import time
from pathlib import Path
from typing import Any

import pytest

from aomgen.api import episodes, run
from aomgen.core.project import Project
from aomgen.errors import InputError
from aomgen.io.atomic import write_text
from aomgen.io.episode_folder import EPISODE_FILE
from aomgen.pipeline.runner import Stage, run_stages
from aomgen.pipeline.stages import STAGES
from aomgen.results import Results

POLL_S = 0.02


def make_units(results: Results, folder: Path, progress: Any) -> dict[str, Any]:
    for number in range(results.project.poses):
        file = folder / f"{number:06d}" / EPISODE_FILE
        if not file.exists():
            write_text(file, f"seed {results.project.seed}")
        progress((number + 1) / results.project.poses, "")
    return {}


@pytest.fixture(autouse=True)
def toy_pipeline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the pipeline by a stage whose episodes hold the seed of the project."""
    stage = Stage(
        name="episodes",
        folder=next(stage.folder for stage in STAGES if stage.name == "episodes"),
        title="Episodes",
        needs=(),
        version=1,
        weight=1.0,
        function=make_units,
        settings=("seed", "poses"),
        incremental=True,
        amount=("poses",),
    )

    def run_toy(project: Project, display: Any, *, until: str) -> list[str]:
        time.sleep(2 * POLL_S)  # The folder is listed before the pipeline begins.
        if project.iterations == 10:
            raise InputError("capture", "cannot be used")
        return run_stages(project, (stage,), display, inputs={}, until=until)

    monkeypatch.setattr(run, "run_pipeline", run_toy)
    monkeypatch.setattr(episodes, "POLL_S", POLL_S)
    monkeypatch.setattr(episodes, "read_episode", lambda folder: (folder / EPISODE_FILE).read_text())


def generated(out: Path, wanted: int, told: list[str] | None = None, **choices: Any) -> list[Any]:
    project = Project(capture=out, out=out, poses=wanted, **choices)
    heard = [] if told is None else told
    return list(episodes._generate(project, wanted, lambda share, text: heard.append(text), {}))


def test_episodes_of_an_earlier_request_are_not_yielded(tmp_path: Path):
    assert generated(tmp_path, 2, seed=1) == ["seed 1"] * 2
    assert generated(tmp_path, 3, seed=2) == ["seed 2"] * 3
    assert generated(tmp_path, 3, seed=2) == ["seed 2"] * 3


def test_episodes_are_not_yielded_if_the_pipeline_refuses_before_it_accepts_them(tmp_path: Path):
    generated(tmp_path, 1, seed=1)
    project = Project(capture=tmp_path, out=tmp_path, poses=1, seed=2, iterations=10)
    made = episodes._generate(project, 1, lambda share, text: None, {})
    with pytest.raises(InputError, match="cannot be used"):
        next(made)


def test_the_progress_is_passed_on(tmp_path: Path):
    told: list[str] = []
    generated(tmp_path, 2, told)
    assert told == ["Episodes"] * 3
