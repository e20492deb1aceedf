"""Computation of many units whose values are saved in one file each, so that an interrupted command can continue."""

import json
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from aomgen.core.progress import Progress
from aomgen.errors import ConfigError
from aomgen.executors import Executor, run_units
from aomgen.io.artifact import load_artifact, save_artifact
from aomgen.io.atomic import remove_folder, remove_staging, write_json
from aomgen.io.reuse import reuse, reuse_object

REQUEST_FILE: Final = "request.json"
T = TypeVar("T")


class SavedUnits(Generic[T]):
    """Folder that holds the value of each unit of a request; damaged values are computed again.

    Args:
        folder: Folder of the values of one request.
        request: JSON values that determine the values of the units.
        kind: Class of the units' values.

    Raises:
        ConfigError: The folder belongs to another request.
    """

    def __init__(self, folder: Path, request: Mapping[str, Any], kind: type[T]) -> None:
        self.folder, self._kind = folder, kind
        place, want = folder / REQUEST_FILE, json.loads(json.dumps(request))
        have = reuse_object(place)
        if have and have != want:
            raise ConfigError(folder, "was begun for something else", "delete it, or choose another name")
        if place.exists() and not have:  # The damaged request may have been another one.
            remove_folder(folder)
        remove_staging(folder)
        write_json(place, want)

    def make(self, units: Iterable[int], executor: Executor, progress: Progress) -> list[T]:
        """Return the values of the units in their order; missing values are computed and saved.

        Args:
            units: Numbers of the units.
            executor: Executor of the missing units; it is closed at the end.
            progress: Receives the progress.

        Raises:
            WorkerError: A unit terminates its process, or takes too long.
            AomgenError: The computation of a unit fails.
        """
        wanted = list(units)
        found = {unit: reuse(self._file(unit), partial(self._load, unit)) for unit in wanted}
        waiting = [unit for unit, value in found.items() if value is None]
        kept = len(wanted) - len(waiting)
        if kept:
            text = (
                f"kept {kept} of {len(wanted)} of an earlier call; another output folder computes all again"
            )
            progress(kept / len(wanted), f"{self.folder.name}: {text}")
        for number, done in enumerate(run_units(waiting, executor), kept + 1):
            save_artifact(self.folder, unit_name(done.unit), done.value)
            progress(number / len(wanted), f"{number} of {len(wanted)}")
        # Computed values are read back, so that they do not depend on which units were saved before.
        found |= {unit: self._load(unit) for unit in waiting}
        return [value for value in found.values() if value is not None]

    def _file(self, unit: int) -> Path:
        return self.folder / f"{unit_name(unit)}.json"

    def _load(self, unit: int) -> T:
        return load_artifact(self.folder, unit_name(unit), self._kind)


def unit_name(unit: int) -> str:
    """Return the name of a unit's file without its suffix."""
    return f"{unit:04d}"
