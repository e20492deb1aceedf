"""Named arrays in one npz file: equal arrays give equal bytes, reading is bounded and unpickled."""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError

# Largest array file read, [bytes]: far above what a run writes, but fits in memory.
MAX_BYTES: Final = 2 << 30


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Uncompressed npz with fixed dates, in the order given."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(array, order="C"), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0)), content.getvalue())
    return buffer.getvalue()


def arrays_from_bytes(data: bytes, where: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an npz.

    Raises:
        MalformedFileError: Not an npz, damaged, or it holds objects.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, KeyError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise MalformedFileError(where, f"is not a readable npz ({error})", "run the stage again") from error


def read_npz(path: Path, *, max_bytes: int = MAX_BYTES) -> dict[str, NDArray[Any]]:
    """All arrays of an npz file.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError: As their names say.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "run the stage again")
    size = path.stat().st_size
    if not size <= max_bytes:
        raise LimitExceededError(path, f"has {size} bytes, limit {max_bytes}")
    return arrays_from_bytes(path.read_bytes(), path)
