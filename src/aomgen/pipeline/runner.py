"""Runs the list of stages: what is up to date is kept, what is not is made anew."""

import fcntl
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from aomgen import __version__
from aomgen.core.progress import Progress
from aomgen.core.project import Project
from aomgen.errors import LockedError, StorageError
from aomgen.io.atomic import remove_folder, remove_staging, staged_folder, write_json, write_text
from aomgen.io.jsonfile import read_json
from aomgen.pipeline.manifest import (
    MANIFEST,
    Manifest,
    describe,
    files_present,
    read_manifest,
    text_digest,
    write_manifest,
)
from aomgen.pipeline.stage import WARNINGS, Stage, results_of
from aomgen.results import Results

TIMINGS = "timings.json"
STARTED = "started.json"

# A stage's version, the digests of its inputs, its parameters.
Identity = tuple[int, dict[str, str], dict[str, Any]]


class Display(Protocol):
    """Where the runner tells what it does: a terminal, or nothing (tests)."""

    def begin(self, stage: Stage, *, fresh: bool) -> None: ...

    def progress(self, share: float, text: str) -> None: ...

    def end(self, stage: Stage, seconds: float, figures: dict[str, Any]) -> None: ...

    def warn(self, stage: Stage, sentence: str) -> None: ...


def run_stages(
    project: Project,
    stages: tuple[Stage, ...],
    display: Display,
    *,
    inputs: Mapping[str, str],
    until: str = "",
) -> list[str]:
    """Bring every stage up to date, in order.

    Args:
        project: The choices of this run.
        stages: The pipeline, in an order in which every stage comes after what it needs.
        display: Hears what happens.
        inputs: Digests of what no stage makes, by the names under which stages need it.
        until: Stop after this stage; all of them when empty.

    Returns:
        Names of the stages that were made anew.

    Raises:
        LockedError: Another process works in the same folder.
        AomgenError: Whatever a stage refuses; nothing half-written stays.
    """
    results = results_of(project, stages)
    _make_folder(project.out)
    with _locked(project.out):
        remove_staging(project.out)
        digests = dict(inputs)
        made: list[str] = []
        for stage in stages:
            kept = _kept(results, stage, digests)
            if kept is None:
                digests[stage.name] = _make(results, stage, digests, display)
                made.append(stage.name)
            else:
                display.begin(stage, fresh=True)
                digests[stage.name] = kept.digest
                _warn(display, stage, kept)
            if stage.name == until:
                break
    return made


def stage_states(project: Project, stages: tuple[Stage, ...]) -> list[tuple[Stage, str]]:
    """Each stage with "done", "partial", "missing", without checking digests of the capture."""
    states = []
    for stage in stages:
        folder = project.out / stage.folder
        manifest = read_manifest(folder)
        if manifest and files_present(folder, manifest):
            states.append((stage, "done"))
        else:
            states.append((stage, "partial" if folder.exists() else "missing"))
    return states


def _wanted(results: Results, stage: Stage, digests: dict[str, str]) -> Identity:
    inputs = {name: digests[name] for name in stage.needs}
    parameters = {name: _plain(getattr(results.project, name)) for name in stage.settings}
    changed = results.project.params.get(stage.name)
    return stage.version, inputs, parameters | ({"params": changed} if changed else {})


def _kept(results: Results, stage: Stage, digests: dict[str, str]) -> Manifest | None:
    """The stage's manifest when its result was made from what the inputs are now."""
    folder = results.folders[stage.name]
    manifest = read_manifest(folder)
    if manifest is None or not files_present(folder, manifest):
        return None
    same = (manifest.version, manifest.inputs, manifest.parameters) == _wanted(results, stage, digests)
    return manifest if same else None


def _make(results: Results, stage: Stage, digests: dict[str, str], display: Display) -> str:
    """Run a stage and commit its folder; the new digest."""
    folder, wanted = results.folders[stage.name], _wanted(results, stage, digests)
    display.begin(stage, fresh=False)
    start = time.monotonic()
    if stage.incremental:
        figures = _work_in_place(results, stage, wanted, display.progress)
        manifest = _finish(folder, stage, wanted, figures)
    else:
        with staged_folder(folder) as staging:
            figures = stage.function(results, staging, display.progress)
            manifest = _finish(staging, stage, wanted, figures)
    seconds = time.monotonic() - start
    _record_seconds(results.out, stage.name, seconds)
    display.end(stage, seconds, manifest.figures)
    _warn(display, stage, manifest)
    return manifest.digest


def _warn(display: Display, stage: Stage, manifest: Manifest) -> None:
    for sentence in manifest.warnings:
        display.warn(stage, sentence)


def _finish(folder: Path, stage: Stage, wanted: Identity, figures: dict[str, Any]) -> Manifest:
    version, inputs, parameters = wanted
    manifest = describe(
        folder,
        stage=stage.name,
        version=version,
        inputs=inputs,
        parameters=parameters,
        figures={name: value for name, value in figures.items() if name != WARNINGS},
        warnings=tuple(figures.get(WARNINGS, ())),
    )
    write_manifest(folder, manifest)
    return manifest


def _work_in_place(results: Results, stage: Stage, wanted: Identity, progress: Progress) -> dict[str, Any]:
    """Continue an incremental stage when it was started for the same inputs, else start it over."""
    folder = results.folders[stage.name]
    version, inputs, parameters = wanted
    deciding = {name: value for name, value in parameters.items() if name not in stage.amount}
    identity = text_digest(repr((__version__, (version, inputs, deciding))))
    started_file = folder / STARTED
    if folder.exists() and not (started_file.is_file() and read_json(started_file) == {"identity": identity}):
        remove_folder(folder)
    _make_folder(folder)
    remove_staging(folder)
    (folder / MANIFEST).unlink(missing_ok=True)  # until the stage is finished again
    write_json(started_file, {"identity": identity})
    return stage.function(results, folder, progress)


def _record_seconds(out: Path, name: str, seconds: float) -> None:
    path = out / TIMINGS
    timings = read_json(path) if path.is_file() else {}
    write_json(path, {**timings, name: round(seconds, 2)})


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(folder, f"cannot be made ({error.strerror})", "choose another folder") from error


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Hold the folder's lock, which the system releases when the process dies."""
    path = out / ".lock"
    if not path.exists():
        write_text(path, "")
    with path.open("r+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise LockedError(
                out, "is in use by another run", "wait for it or choose another folder"
            ) from error
        yield


def _plain(value: Any) -> Any:
    """The value as JSON gives it back, so that parameters compare equal after a round trip."""
    return list(value) if isinstance(value, tuple) else value
