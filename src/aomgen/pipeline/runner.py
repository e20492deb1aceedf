"""Execute the stages of a run: results that are up to date are kept, others are recomputed."""

import fcntl
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Protocol

from aomgen.core.progress import Progress
from aomgen.core.project import Project
from aomgen.errors import LockedError, StorageError
from aomgen.io.atomic import NO_LOCKS, remove_folder, remove_staging, stage_folder, write_json, write_text
from aomgen.io.reuse import DAMAGE, reuse, reuse_object, warn_of_file
from aomgen.pipeline.manifest import (
    MANIFEST,
    Identity,
    Manifest,
    find_damage,
    read_manifest,
    text_digest,
    write_manifest,
)
from aomgen.results import Results
from aomgen.version import __version__

TIMINGS = "timings.json"
STARTED = "started.json"
LOCK_FILE = ".lock"
# Key of a stage's metrics that holds warnings for the user about the input.
WARNINGS = "warnings"

# Function that runs a stage in the given folder and returns its metrics.
StageFunction = Callable[[Results, Path, Progress], dict[str, Any]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """One step of the pipeline.

    Attributes:
        name: For example "structure".
        folder: Folder below the run's folder, for example "01_structure".
        title: Title that is shown while the stage runs.
        needs: Names of the stages whose results it reads; also "capture" if it reads the capture, "assets" if it reads the
            asset files of the project, and "review" if it excludes rejected episodes.
        settings: Names of the project settings that change its result.
        version: Version, which is increased when the same inputs may give other bytes.
        weight: Run time with the bundled recording on two cores, [s], for the display of the remaining time.
        function: Function that runs the stage.
        incremental: Whether the stage works in its final folder, commits item by item or writes checkpoints, and
            continues there after a kill.
        amount: Settings that only change the number of items of an incremental stage; existing items remain.
        forget: Function that deletes the items to which damaged files belong, given the folder and the relative paths of
            the files; None to compute the whole stage again.
        bulky: The files may be too many to be read whenever a run is continued, so that only their sizes are checked.
    """

    name: str
    folder: str
    title: str
    needs: tuple[str, ...]
    version: int
    weight: float
    function: StageFunction
    settings: tuple[str, ...] = ()
    incremental: bool = False
    amount: tuple[str, ...] = ()
    forget: Callable[[Path, list[str]], None] | None = None
    bulky: bool = False


class Display(Protocol):
    """Receiver of the progress of a run, for example a terminal."""

    def begin(self, stage: Stage, *, fresh: bool) -> None:
        """Show the start of a stage; `fresh` means that its result is up to date and kept.

        Items that an incremental stage cannot keep have been deleted before.
        """
        ...

    def progress(self, share: float, text: str) -> None:
        """Show the completed share (0..1) of the current stage, with a short text."""
        ...

    def end(self, stage: Stage, seconds: float, figures: dict[str, Any]) -> None:
        """Show the end of a stage with its run time, [s], and its metrics."""
        ...

    def warn(self, stage: Stage, sentence: str) -> None:
        """Show a warning for the user."""
        ...


def results_of(project: Project, stages: Sequence[Stage], **machine: Any) -> Results:
    """Return the results of a project, whose folder may not exist yet.

    Args:
        project: Settings of the run.
        stages: Stages of the pipeline.
        **machine: Fields `workers`, `ray` and `store` of `Results`.
    """
    folders = {stage.name: project.out / stage.folder for stage in stages}
    return Results(project=project, out=project.out, folders=folders, **machine)


def run_stages(
    project: Project,
    stages: tuple[Stage, ...],
    display: Display,
    *,
    inputs: Mapping[str, str],
    until: str = "",
    **machine: Any,
) -> list[str]:
    """Bring every stage up to date, in order.

    Args:
        project: Settings of the run.
        stages: Stages of the pipeline; every stage follows the stages that it needs.
        display: Receives the progress.
        inputs: Digests of the inputs that no stage creates, by the names in `Stage.needs`.
        until: Last stage to run; all stages are run if it is empty.
        **machine: See `results_of`.

    Returns:
        Names of the stages that were recomputed.

    Raises:
        LockedError: Another process uses the same folder.
        AomgenError: A stage failed; no incomplete file remains.
    """
    results = results_of(project, stages, **machine)
    with lock(project.out):
        remove_staging(project.out)
        digests = dict(inputs)
        made: list[str] = []
        for stage in stages:
            kept = _kept(results, stage, digests)
            if kept is None:
                made.append(stage.name)
                manifest = _make(results, stage, digests, display)
            else:
                display.begin(stage, fresh=True)
                manifest = kept
            digests[stage.name] = manifest.digest
            for sentence in manifest.warnings:
                display.warn(stage, sentence)
            if stage.name == until:
                break
    return made


def share_stages(folders: Iterable[Path], out: Path) -> None:
    """Link the files of finished stages into the folder of another run, which must not change them.

    Args:
        folders: Folders of the stages; those that do not exist are skipped.
        out: Folder of the other run; stages that exist there are kept.

    Raises:
        LockedError: The other run is in progress.
        StorageError: Writing to the disk failed.
    """
    with lock(out):
        for folder in folders:
            if folder.is_dir() and not (out / folder.name).exists():
                with stage_folder(out / folder.name) as staging:
                    _link_tree(folder, staging)


def _link_tree(source: Path, target: Path) -> None:
    """Link all files below a folder into another one."""
    for path in sorted(source.rglob("*")):
        copy = target / path.relative_to(source)
        if path.is_dir():
            copy.mkdir()
        else:
            _link(path, copy)


def _link(source: Path, target: Path) -> None:
    """Link a file, or copy it if the target is on another file system."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def stage_states(project: Project, stages: tuple[Stage, ...]) -> list[tuple[Stage, str]]:
    """Return each stage with its state ("done", "partial" or "missing"), without checking digests of the capture."""
    return [(stage, state) for stage, state, _ in stage_manifests(project, stages)]


def stage_manifests(
    project: Project, stages: tuple[Stage, ...]
) -> Iterator[tuple[Stage, str, Manifest | None]]:
    """Yield each stage with its state, see `stage_states`, and its manifest if it has one."""
    for stage in stages:
        folder = project.out / stage.folder
        try:
            manifest = read_manifest(folder)
        except DAMAGE:  # The next run warns of it.
            manifest = None
        if manifest and not any(find_damage(folder, manifest)):
            yield stage, "done", manifest
        else:
            yield stage, "partial" if folder.exists() else "missing", manifest


def _identify(results: Results, stage: Stage, digests: dict[str, str]) -> Identity:
    inputs = {name: digests[name] for name in stage.needs}
    # Parameters are converted to JSON values, so that they are equal after a round trip through the manifest.
    parameters = results.project.model_dump(mode="json", include=set(stage.settings))
    changed = results.project.params.get(stage.name)
    return stage.version, inputs, parameters | ({"params": changed} if changed else {})


def _kept(results: Results, stage: Stage, digests: dict[str, str]) -> Manifest | None:
    """Return the manifest of a stage if its result was computed from the current inputs and is not damaged, else None.

    Damaged items are forgotten, so that they are computed again.
    """
    folder = results.folders[stage.name]
    manifest = reuse(folder / MANIFEST, partial(read_manifest, folder))
    if manifest is None or manifest.identity != _identify(results, stage, digests):
        return None
    damaged = list(find_damage(folder, manifest, content=not stage.bulky))
    if not damaged:
        return manifest
    others = f" and {len(damaged) - 1} more" if len(damaged) > 1 else ""
    warn_of_file(
        folder, f"the stage '{stage.name}' has finished, but its files {damaged[0]}{others} are damaged"
    )
    if stage.forget is not None:
        stage.forget(folder, damaged)
    elif stage.incremental:
        (folder / STARTED).unlink(missing_ok=True)
    return None


def _make(results: Results, stage: Stage, digests: dict[str, str], display: Display) -> Manifest:
    """Run a stage and commit its folder."""
    folder, wanted = results.folders[stage.name], _identify(results, stage, digests)
    start = time.monotonic()
    if stage.incremental:
        _begin_in_place(folder, stage, wanted)
    display.begin(stage, fresh=False)
    if stage.incremental:
        manifest = _finish(folder, stage, wanted, stage.function(results, folder, display.progress))
    else:
        with stage_folder(folder) as staging:
            manifest = _finish(staging, stage, wanted, stage.function(results, staging, display.progress))
    seconds = time.monotonic() - start
    path = results.out / TIMINGS
    write_json(path, {**reuse_object(path), stage.name: round(seconds, 2)})
    display.end(stage, seconds, manifest.figures)
    return manifest


def _finish(folder: Path, stage: Stage, wanted: Identity, figures: dict[str, Any]) -> Manifest:
    warnings = tuple(figures.pop(WARNINGS, ()))
    return write_manifest(folder, stage.name, wanted, figures, warnings)


def _begin_in_place(folder: Path, stage: Stage, wanted: Identity) -> None:
    """Keep the items of an incremental stage if it was started with the same inputs, else delete them."""
    version, inputs, parameters = wanted
    deciding = {name: value for name, value in parameters.items() if name not in stage.amount}
    identity = text_digest(repr((__version__, (version, inputs, deciding))))
    started_file = folder / STARTED
    if folder.exists() and reuse_object(started_file) != {"identity": identity}:
        remove_folder(folder)
    _make_folder(folder)
    remove_staging(folder)
    (folder / MANIFEST).unlink(missing_ok=True)  # deleted until the stage is finished again
    write_json(started_file, {"identity": identity})


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = f"cannot be made ({error.strerror or error})"
        raise StorageError(folder, reason, "choose another folder") from error


@contextmanager
def lock(out: Path) -> Iterator[None]:
    """Create the folder of a run and hold its lock, which the system releases when the process dies.

    On a file system without locks, the user is warned, and simultaneous runs are not detected.

    Raises:
        LockedError: Another run holds it.
        StorageError: Writing to the disk failed.
    """
    _make_folder(out)
    path = out / LOCK_FILE
    if not path.exists():
        write_text(path, "")
    with path.open("r+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise LockedError(
                out, "is in use by another run", "wait for it or choose another folder"
            ) from error
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            _warn_without_locks(out)
        yield


@cache
def _warn_without_locks(out: Path) -> None:
    """Warn once for each folder, although a run acquires its lock several times."""
    warn_of_file(out, "is on a file system without locks", "simultaneous runs are not detected")
