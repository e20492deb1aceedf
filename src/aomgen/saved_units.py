"""Work of many small units, one file each: what a killed command has made is kept."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from aomgen.core.progress import Progress
from aomgen.errors import ConfigError
from aomgen.executors import Executor, run_units
from aomgen.io.artifact import load_artifact, read_json, save_artifact
from aomgen.io.atomic import remove_staging, write_json

REQUEST_FILE: Final = "request.json"
T = TypeVar("T")


class SavedUnits(Generic[T]):
    """A folder with a value of each unit.

    Args:
        folder: Folder of the values of one request.
        request: JSON values that the units are made from.
        kind: Class of the values.

    Raises:
        ConfigError: The folder belongs to another request.
    """

    def __init__(self, folder: Path, request: Mapping[str, Any], kind: type[T]) -> None:
        self.folder, self._kind = folder, kind
        place, want = folder / REQUEST_FILE, dict(request)
        if place.is_file() and read_json(place) != want:
            raise ConfigError(folder, "was begun for something else", "delete it, or choose another name")
        remove_staging(folder)
        write_json(place, want)

    def make(self, units: Iterable[int], executor: Executor, progress: Progress) -> list[T]:
        """Values of the units in their order; those that are not there are made by the executor, which is closed then.

        Raises:
            WorkerError: A unit kills its process, or takes too long.
            AomgenError: Whatever the work raises.
        """
        wanted = list(units)
        waiting = [unit for unit in wanted if not (self.folder / f"{unit_name(unit)}.json").is_file()]
        kept = len(wanted) - len(waiting)
        for number, done in enumerate(run_units(waiting, executor), kept + 1):
            save_artifact(self.folder, unit_name(done.unit), done.value)
            progress(number / len(wanted), f"{number} of {len(wanted)}")
        return [load_artifact(self.folder, unit_name(unit), self._kind) for unit in wanted]


def unit_name(unit: int) -> str:
    """Name of a unit's file, without its ending."""
    return f"{unit:04d}"
