"""The one way files are created: staged beside their place, synced, renamed."""

import json
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.errors import StorageError

STAGING_PREFIX = ".staging-"


def write_bytes(path: Path, data: bytes) -> None:
    """Create or replace one file; readers see the old content or the new, never a part.

    Raises:
        StorageError: The disk refuses (full, read-only, no permission).
    """
    staging = path.parent / f"{STAGING_PREFIX}{uuid.uuid4().hex}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with staging.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        staging.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        if staging.exists():
            staging.unlink()
        raise StorageError(
            path, f"cannot be written ({error.strerror})", "free space or choose another folder"
        ) from error


def write_text(path: Path, text: str) -> None:
    """Create or replace a UTF-8 text file; see `write_bytes`."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """Create or replace a JSON file with sorted keys; arrays become lists, NaN is refused."""
    text = json.dumps(value, indent=1, sort_keys=True, allow_nan=False, default=_plain)
    write_text(path, text + "\n")


@contextmanager
def staged_folder(path: Path) -> Iterator[Path]:
    """A folder that appears at `path` complete, or not at all.

    Yields an empty folder beside `path`; when the block ends without an error its files are
    synced and it replaces whatever stood at `path`.

    Raises:
        StorageError: The disk refuses.
    """
    staging = path.parent / f"{STAGING_PREFIX}{uuid.uuid4().hex}"
    try:
        staging.mkdir(parents=True)
        yield staging
        for file in sorted(staging.rglob("*")):
            if file.is_file():
                with file.open("rb") as handle:
                    os.fsync(handle.fileno())
        _sync_folder(staging)
        if path.exists():
            discarded = path.parent / f"{STAGING_PREFIX}{uuid.uuid4().hex}"
            path.replace(discarded)
            staging.replace(path)
            shutil.rmtree(discarded)
        else:
            staging.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        raise StorageError(
            path, f"cannot be written ({error.strerror})", "free space or choose another folder"
        ) from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def remove_staging(folder: Path) -> None:
    """Delete what a killed run left half-written directly below `folder`."""
    for path in folder.glob(f"{STAGING_PREFIX}*"):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return value.as_posix()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")
