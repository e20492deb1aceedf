"""`check`, `init` and `run` look at the same things before work starts, and look once."""

import sys
from contextlib import redirect_stderr, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from unittest.mock import patch

import pytest

from aomgen.cli.app import main
from aomgen.core.project import Project
from aomgen.errors import (
    AomgenError,
    BackendError,
    ConfigError,
    LockedError,
    MalformedFileError,
    StorageError,
)
from aomgen.io.reuse import StoredFileWarning
from aomgen.pipeline import preflight
from aomgen.pipeline.runner import lock
from aomgen.pipeline.stages import PROJECT_FILE, run_pipeline
from broken_captures import CAPTURES, write_tight_usd


@pytest.fixture(autouse=True)
def complete_machine(monkeypatch) -> None:
    """Tests of captures do not depend on what this machine has."""
    monkeypatch.setattr(preflight, "require_environment", lambda *_, **__: None)


def project_of(capture: Path, out: Path, **choices) -> Project:
    return Project(capture=capture, out=out, assets=("microwave:1",), **choices)


class Heard:
    """A display that keeps warnings."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def __enter__(self) -> "Heard":
        return self

    def __exit__(self, *_: object) -> None: ...

    def warn(self, stage, sentence: str) -> None:
        self.warnings.append(sentence)


@pytest.fixture
def no_work(monkeypatch) -> list[str]:
    """Stages are not run; what would have been started is listed."""
    started: list[str] = []

    def run_stages(project, stages, display, **_):
        started.append("stages")
        return []

    monkeypatch.setattr("aomgen.pipeline.stages.run_stages", run_stages)
    return started


def test_a_run_tells_the_warnings_every_time_and_checks_once(small_copy, tmp_path, monkeypatch, no_work):
    CAPTURES["log with 15 Hz"].damage(small_copy)
    project, first, second = project_of(small_copy, tmp_path / "out"), Heard(), Heard()
    run_pipeline(project, first)
    monkeypatch.setattr(preflight, "check_capture", None)
    run_pipeline(project, second)
    assert "14 rows per second" in first.warnings[0]
    assert first.warnings == second.warnings
    assert no_work == ["stages", "stages"]


def test_a_change_is_checked_again(small_copy, tmp_path, no_work):
    project = project_of(small_copy, tmp_path / "out")
    run_pipeline(project, Heard())
    CAPTURES["truncated image"].damage(small_copy)
    with pytest.raises(MalformedFileError):
        run_pipeline(project, Heard())
    assert no_work == ["stages"]


def test_somebody_s_dataset_is_not_replaced(small_capture, tmp_path, no_work):
    (tmp_path / "dataset").mkdir()
    project = project_of(small_capture, tmp_path)
    run_pipeline(project, Heard())
    (tmp_path / "dataset" / "years_of_work.h5").write_text("")
    with pytest.raises(StorageError, match="dataset: was not created by a run"):
        run_pipeline(project, Heard())
    assert no_work == ["stages"]


def test_the_machine_is_asked_about_stages_that_are_not_done(small_capture, tmp_path, monkeypatch, no_work):
    asked: list[list[str]] = []
    monkeypatch.setattr(preflight, "require_environment", lambda stages, *_, **__: asked.append(list(stages)))
    monkeypatch.setattr(
        preflight, "stage_states", lambda project, stages: [(stage, "done") for stage in stages]
    )
    project = project_of(small_capture, tmp_path / "out")
    run_pipeline(project, Heard(), until="gaussians")
    run_pipeline(project, Heard(), until="gaussians")
    assert asked == [["structure", "gaussians"]]
    with pytest.raises(ConfigError, match="did you mean 'gaussians'"):
        run_pipeline(project, Heard(), until="gaussian")


def test_a_cluster_that_does_not_answer_starts_nothing(small_capture, tmp_path, no_work):
    project = project_of(small_capture, tmp_path / "out")
    with pytest.raises(
        BackendError, match=r"--ray 127\.0\.0\.1:1: no Ray cluster replies|ray: is not installed"
    ):
        run_pipeline(project, Heard(), ray="127.0.0.1:1")
    assert not project.out.exists()
    run_pipeline(project, Heard(), until="twin", ray="127.0.0.1:1")
    assert no_work == ["stages"]


def test_a_store_that_cannot_be_used_starts_nothing(small_capture, tmp_path, no_work):
    project = project_of(small_capture, tmp_path / "out")
    with pytest.raises(AomgenError, match=r"--store what://x: is not a known kind|fsspec: is not installed"):
        run_pipeline(project, Heard(), store="what://x")
    assert not project.out.exists()


def test_a_damaged_record_of_the_check_is_replaced(small_capture, tmp_path, no_work):
    project = project_of(small_capture, tmp_path / "out")
    run_pipeline(project, Heard())
    record = project.out / preflight.CHECKED_FILE
    intact = record.read_bytes()
    record.write_text("[")
    with pytest.warns(StoredFileWarning, match=record.name) as warned:
        run_pipeline(project, Heard())
    assert len(warned) == 1
    assert record.read_bytes() == intact


def test_a_second_run_leaves_the_choices_of_the_first(small_capture, tmp_path, no_work):
    project = project_of(small_capture, tmp_path / "out")
    run_pipeline(project, Heard())
    choices = (project.out / PROJECT_FILE).read_text()
    with lock(project.out), pytest.raises(LockedError, match="is in use by another run; wait for it"):
        run_pipeline(project.model_copy(update={"poses": 9}), Heard())
    assert (project.out / PROJECT_FILE).read_text() == choices
    assert no_work == ["stages"]


def aomgen(*arguments: object) -> tuple[str, str]:
    out, err = StringIO(), StringIO()
    words = ["aomgen", *map(str, arguments)]
    with (
        redirect_stdout(out),
        redirect_stderr(err),
        patch.object(sys, "argv", words),
        suppress(SystemExit),
    ):
        main()
    return out.getvalue(), err.getvalue()


@pytest.mark.parametrize("name", ["truncated image", "log in milliseconds"])
def test_every_command_refuses_alike(small_copy, tmp_path, monkeypatch, no_work, name):
    monkeypatch.chdir(tmp_path)
    aomgen("init", "capture")
    assert Path("project.toml").is_file()
    CAPTURES[name].damage(small_copy)
    errors = {
        aomgen(*words)[1]
        for words in (
            ("check", "capture"),
            ("check", "project.toml"),
            ("init", "capture", "--project", "other.toml"),
            ("run", "project.toml"),
        )
    }
    assert not Path("other.toml").exists()
    assert not Path("out").exists()
    assert no_work == []
    assert len({error.replace(f"{tmp_path}/", "") for error in errors}) == 1
    assert all(word in errors.pop() for word in CAPTURES[name].words[:1])


def test_check_and_init_tell_warnings(small_copy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    CAPTURES["log with 15 Hz"].damage(small_copy)

    def lacking(*_, **__):
        raise BackendError("torch", "is not installed", "pip install torch")

    monkeypatch.setattr(preflight, "require_environment", lacking)
    for words in (("check", "capture"), ("init", "capture"), ("check", "project.toml")):
        shown = aomgen(*words)[0]
        assert "warning: " in shown
        assert "14 rows per second" in shown
        assert "a run on this machine would stop: torch: is not installed" in shown


def test_check_of_a_capture_tells_of_its_category(small_copy):
    CAPTURES["unknown category"].damage(small_copy)
    assert "did you mean 'toolbox'?" in aomgen("check", small_copy)[0]


@pytest.mark.parametrize("name", ["project.toml", "cabinet.usda"])
def test_check_writes_a_page_of_a_capture_only(tmp_path, name):
    _, error = aomgen("check", tmp_path / name, "--html", tmp_path / "page.html")[:2]
    assert "--html: shows the images of a capture; give the folder of the capture" in error
    assert list(tmp_path.iterdir()) == []


def test_check_refuses_a_usd_that_a_run_would_refuse(tmp_path):
    write_tight_usd(tmp_path / "tight.usda")
    assert "opens by 0.1 only" in aomgen("check", tmp_path / "tight.usda")[1]
