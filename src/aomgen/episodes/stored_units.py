"""Units of workers that have no access to the run's folders: inputs and results pass through a store.

```
STORE/<run>/inputs.zip   files that every worker needs; the worker unpacks them into a temporary folder
STORE/<run>/000005.zip   files of a unit: its episode and object, or its rejection
```
The worker writes a unit as it would write it into the run's folder, and puts its files into the store. The run fetches each unit,
commits it, and then counts it. If the run is interrupted, it takes the units that are in the store without computing them again.
"""

import os
import tempfile
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final, Self

from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.grasp_choice import GRASPS_FOLDER
from aomgen.episodes.ledger import Unit, unit_paths
from aomgen.errors import MalformedFileError, StorageError
from aomgen.executors import Done, Executor, Opener
from aomgen.io.atomic import (
    remove_folder,
    remove_staging,
    scratch_folder,
    stage_folder,
    write_bytes,
    write_json,
)
from aomgen.io.reuse import reuse_object, warn_of_file
from aomgen.results import BACKGROUND_FOLDER, Results
from aomgen.robots.loading import load_stored_robot, save_robot
from aomgen.store import Store

# File with the name of the run in the store. It is deleted with the stage's folder if the inputs change, and at the end.
RUN_FILE: Final = "store.json"
INPUTS, ROBOT = "inputs", "robot"
# Results that workers get as values, because they are computed from the capture and several stages.
CARRIED: Final = ("recorded", "alignment", "demonstration", "fps")


def share_inputs(results: Results, folder: Path) -> tuple[Store, Opener]:
    """Put the inputs of the workers into the store of a run.

    Args:
        results: Results of the run, with the URL of the store.
        folder: Folder of all episodes.

    Returns:
        The store of this run, and the function that opens a worker.

    Raises:
        StorageError: The store or the folder cannot be used.
    """
    run = reuse_object(folder / RUN_FILE).get("run") or uuid.uuid4().hex
    write_json(folder / RUN_FILE, {"run": run})
    store = Store(f"{results.store}/{run}")
    store.begin()
    with tempfile.TemporaryDirectory() as scratch:
        save_robot(Path(scratch), results.recorded.robot)
        files = {
            f"{ROBOT}/{name}": data for name, data in _read_files(Path(scratch), [Path(scratch)]).items()
        }
    fitted = results.folders["replacement"]
    files |= _read_files(fitted.parent, [path for path in fitted.iterdir() if path.name != BACKGROUND_FOLDER])
    grasps = _read_files(folder, [folder / GRASPS_FOLDER])
    files |= {f"{folder.name}/{name}": data for name, data in grasps.items()}
    store.put(INPUTS, files)
    values = {name: getattr(results, name) for name in CARRIED}
    return store, partial(StoringWorker, store.url, replace(results), values)


class StoringWorker:
    """Work of a worker that puts the files of each unit into a store.

    Args:
        url: URL of the run's store.
        results: Results of the run, whose folders this computer need not have.
        values: Results that are given as values, by name.

    Raises:
        StorageError: The store or the temporary folder cannot be used.
    """

    def __init__(self, url: str, results: Results, values: Mapping[str, Any]) -> None:
        self._store = Store(url)
        # The folder is deleted with this object; that of a killed worker is deleted by the next one.
        self._scratch = scratch_folder(_workers_folder())
        root = self._scratch.__enter__()
        _write_files(root, self._store.get(INPUTS))
        folders = {name: root / path.name for name, path in results.folders.items()}
        here = replace(results, out=root, folders=folders)
        vars(here).update(values, robot=load_stored_robot(root / ROBOT))
        self._folder = folders["episodes"]
        self._make = EpisodeFactory(here, self._folder).make

    def __call__(self, unit: Unit) -> tuple[bool, dict[str, float]]:
        """Make a unit, see `EpisodeFactory.make`, and move its files to the store."""
        value = self._make(unit)
        paths = [path for path in unit_paths(self._folder, unit) if path.exists()]
        self._store.put(_name(unit), _read_files(self._folder, paths))
        for path in paths:
            remove_folder(path)
        return value


class StoredUnits:
    """Executor that commits the units of `StoringWorker` in the run's folder.

    Args:
        executor: Executor of the workers.
        store: Store of the run.
        folder: Folder of all episodes.
    """

    def __init__(self, executor: Executor, store: Store, folder: Path) -> None:
        self.slots = executor.slots
        self._executor, self._store, self._folder = executor, store, folder
        self._found = list[Done]()

    @cached_property
    def _earlier(self) -> set[str]:
        """Names of the archives that an interrupted run has left in the store."""
        return self._store.names()

    def __enter__(self) -> Self:
        self._executor.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        self._executor.__exit__(*exception)

    def submit(self, unit: Unit) -> None:
        """Commit a unit that an interrupted run has left in the store, or start its execution."""
        if _name(unit) in self._earlier:
            try:
                self._found.append(Done(unit=unit, value=(self._commit(unit), {})))
                return
            except MalformedFileError as error:
                warn_of_file(error.where, error.problem)
        self._executor.submit(unit)

    def next_done(self) -> Done:
        """Wait until a unit has ended, commit it and return its result, or raise the error of its work."""
        if self._found:
            return self._found.pop()
        done = self._executor.next_done()
        if not done.lost:
            self._commit(done.unit)
        return done

    def _commit(self, unit: Unit) -> bool:
        """Fetch the files of a unit and commit them; return whether it is an episode."""
        files = self._store.get(_name(unit))
        *folders, rejection = unit_paths(self._folder, unit)
        committed = False
        for path in folders:
            prefix = f"{path.relative_to(self._folder).as_posix()}/"
            inside = {
                name.removeprefix(prefix): data for name, data in files.items() if name.startswith(prefix)
            }
            committed = bool(inside)
            if inside:
                with stage_folder(path) as staging:
                    _write_files(staging, inside)
        if not committed:
            name = rejection.relative_to(self._folder).as_posix()
            if name not in files:
                raise MalformedFileError(
                    f"{self._store.url}/{_name(unit)}.zip", "contains no unit", "delete it"
                )
            write_bytes(rejection, files[name])
        return committed


def _name(unit: Unit) -> str:
    return f"{unit.number:06d}"


def _read_files(root: Path, paths: Iterable[Path]) -> dict[str, bytes]:
    """Read files, and all files in folders, by their paths relative to a folder."""
    found = [file for path in paths for file in ([path] if path.is_file() else sorted(path.rglob("*")))]
    return {file.relative_to(root).as_posix(): file.read_bytes() for file in found if file.is_file()}


def _write_files(root: Path, files: Mapping[str, bytes]) -> None:
    for name, data in files.items():
        write_bytes(root / name, data)


def _workers_folder() -> Path:
    """Return the folder of this user's workers on this computer, without the folders of dead workers."""
    folder = Path(tempfile.gettempdir(), f"aomgen-workers-{os.getuid()}")
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise StorageError(
            folder, f"cannot be made ({error.strerror})", "free space, or set TMPDIR"
        ) from error
    if folder.lstat().st_uid != os.getuid():
        raise StorageError(folder, "belongs to another user", "set TMPDIR to another folder")
    remove_staging(folder)
    return folder
