"""ArrayRecord files, whose records can be read in any order: what loaders made with Grain read; by Google's own library."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from aomgen.datasets.tfrecord import REMEDY
from aomgen.errors import BackendError, MalformedFileError, MissingFileError

# Every record can be asked for alone.
OPTIONS: Final = "group_size:1"


def require_array_record() -> Any:
    """The library.

    Raises:
        BackendError: It is not installed.
    """
    try:
        from array_record.python import array_record_module
    except ImportError as error:
        raise BackendError(
            "array_record", "is not installed", "pip install 'aomgen[array-record]'"
        ) from error
    return array_record_module


def write_array_record(path: Path, records: Iterable[bytes]) -> None:
    """Write a file; its folder is there."""
    writer = require_array_record().ArrayRecordWriter(str(path), OPTIONS)
    for record in records:
        writer.write(record)
    writer.close()


def read_array_record(path: Path) -> list[bytes]:
    """The records of a file.

    Raises:
        MissingFileError: No such file.
        MalformedFileError: It is cut or damaged.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", REMEDY)
    try:
        return require_array_record().ArrayRecordReader(str(path)).read_all()
    except RuntimeError as error:
        raise MalformedFileError(path, f"is no sound ArrayRecord file ({error})", REMEDY) from error
