"""Atomic creation of files and folders: they are written next to their destination, synced and renamed.

A file or folder that is being written is called staging; its name begins with `STAGING_PREFIX`. The writer holds a lock
on it (flock), which the kernel releases when the writer dies, and `remove_staging` deletes only staging that it can lock.
Subprocesses that execute another program do not inherit the lock. Forked children do, so the staging of a dead parent may
remain until its forked children have ended.
"""

import ctypes
import errno
import fcntl
import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.errors import StorageError

STAGING_PREFIX: Final = ".staging-"
# Error codes of flock on file systems without locks (some NFS), and of renameat2 on those without exchange.
NO_LOCKS: Final = (errno.EBADF, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
NO_EXCHANGE: Final = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP)
# From <fcntl.h> and <linux/fs.h>.
AT_FDCWD, RENAME_EXCHANGE = -100, 2


def write_bytes(path: Path, data: bytes) -> None:
    """Create or replace one file; readers get the complete old or the complete new content.

    Raises:
        StorageError: Writing to the disk failed (full, read-only, no permission).
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _staging(path.parent, _new_file) as (staging, handle):
            with open(handle, "wb", closefd=False) as file:
                file.write(data)
            os.fsync(handle)
            staging.replace(path)
            _sync(path.parent)
    except OSError as error:
        raise _cannot_be_written(path, error) from error


def write_text(path: Path, text: str) -> None:
    """Create or replace a UTF-8 text file; see `write_bytes`."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """Create or replace a JSON file with sorted keys; see `write_bytes`.

    Arrays become lists, paths become strings.

    Raises:
        StorageError: Writing to the disk failed.
        ValueError, TypeError: A number is NaN or infinite, or a value has no JSON form. This is a programming error.
    """
    text = json.dumps(value, indent=1, sort_keys=True, allow_nan=False, default=_plain)
    write_text(path, text + "\n")


@contextmanager
def stage_folder(path: Path) -> Iterator[Path]:
    """Create or replace the folder `path` completely, or not at all.

    The context manager yields an empty folder next to `path`. When the block ends without an error, the files of this
    folder are synced, and it replaces the file or folder at `path`. On Linux, the old and the new folder are exchanged in
    one step. If the file system does not support this (NFS), the old one is renamed first; a process that dies before the
    second rename leaves no folder at `path`. If `path` is a symbolic link, the folder to which it points is replaced.

    Raises:
        StorageError: Writing to the disk failed.
    """
    path = Path(os.path.realpath(path))
    try:
        with scratch_folder(path.parent) as staging:
            yield staging
            for item in [*sorted(staging.rglob("*")), staging]:
                _sync(item)
            _put_in_place(staging, path)
    except OSError as error:
        raise _cannot_be_written(path, error) from error


@contextmanager
def scratch_folder(parent: Path) -> Iterator[Path]:
    """Create an empty folder in `parent` that is deleted when the block ends."""
    parent.mkdir(parents=True, exist_ok=True)
    with _staging(parent, _new_folder) as (staging, _):
        yield staging


def remove_folder(path: Path) -> None:
    """Delete a folder in one step, so that other processes never find a part of it.

    Raises:
        StorageError: Writing to the disk failed.
    """
    try:
        with scratch_folder(path.parent) as discarded:
            path.replace(discarded / path.name)
    except OSError as error:
        raise _cannot_be_deleted(path, error) from error


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Hold an exclusive lock on a folder; other processes that lock it wait. Without file locks this has no effect.

    Raises:
        StorageError: The folder cannot be opened.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        reason = f"cannot be opened ({error.strerror or error})"
        raise StorageError(folder, reason, "check the folder") from error
    try:
        _lock(handle, wait=True)
        yield
    finally:
        os.close(handle)


def is_vacant(path: Path) -> bool:
    """Return whether a path does not exist or is an empty folder, so that a new folder replaces nothing."""
    return not path.exists() or (path.is_dir() and not any(path.iterdir()))


def remove_staging(folder: Path) -> None:
    """Delete incomplete files and folders of dead processes directly in `folder`.

    The staging of running processes remains. On a file system without locks, all staging remains.

    Raises:
        StorageError: Writing to the disk failed.
    """
    for path in folder.glob(f"{STAGING_PREFIX}*"):
        try:
            _remove_if_dead(path)
        except OSError as error:
            raise _cannot_be_deleted(path, error) from error


def _remove_if_dead(path: Path) -> None:
    try:
        handle = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return
    try:
        # The writer may have renamed the file in the meantime, which makes it a result that must not be deleted.
        if _lock(handle, wait=False) and _is_at(handle, path):
            _delete(path)
    finally:
        os.close(handle)


@contextmanager
def _staging(parent: Path, create: Callable[[Path], int]) -> Iterator[tuple[Path, int]]:
    """Create a file or folder and yield its path and locked descriptor; delete a path that remains at the end."""
    while True:
        path = parent / f"{STAGING_PREFIX}{uuid.uuid4().hex}"
        handle = create(path)
        try:
            _lock(handle, wait=True)
            if not _is_at(handle, path):
                continue  # another process removed it before it was locked
            try:
                yield path, handle
            finally:
                _delete(path)
            return
        finally:
            os.close(handle)


def _new_file(path: Path) -> int:
    return os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)


def _new_folder(path: Path) -> int:
    while True:
        path.mkdir()
        try:
            return os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:  # another process removed it before it was opened
            continue


def _lock(handle: int, *, wait: bool) -> bool:
    """Acquire the lock; return False if another process holds it, or if the file system has no locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return False
    return True


def _is_at(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.lstat())
    except FileNotFoundError:
        return False


def _put_in_place(staging: Path, path: Path) -> None:
    """Move a folder to `path`; the previous content of `path` is moved to `staging` or deleted."""
    if not path.exists():
        staging.replace(path)
    elif not _exchange(staging, path):
        with scratch_folder(path.parent) as discarded:
            old = path.replace(discarded / path.name)
            try:
                staging.replace(path)
            except OSError:
                old.replace(path)
                raise
    _sync(path.parent)


def _exchange(first: Path, second: Path) -> bool:
    """Exchange two paths in one step; return False if the system does not support this."""
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "renameat2"):
        return False
    names = (os.fsencode(first), os.fsencode(second))
    if libc.renameat2(AT_FDCWD, names[0], AT_FDCWD, names[1], ctypes.c_uint(RENAME_EXCHANGE)) == 0:
        return True
    code = ctypes.get_errno()
    if code in NO_EXCHANGE:
        return False
    raise OSError(code, os.strerror(code), str(second))


def _delete(path: Path) -> None:
    """Delete a file, link or folder; files that other processes delete in the meantime are ignored."""

    def unless_gone(function: Any, name: str, info: Any) -> None:
        if not isinstance(info[1], FileNotFoundError):
            raise info[1]

    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, onerror=unless_gone)
    else:
        path.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Write the content of a file, or the entries of a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _cannot_be_written(path: Path, error: OSError) -> StorageError:
    reason = f"cannot be written ({error.strerror or error})"
    return StorageError(path, reason, "free space or choose another folder")


def _cannot_be_deleted(path: Path, error: OSError) -> StorageError:
    return StorageError(path, f"cannot be deleted ({error.strerror or error})", "delete it by hand")


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return value.as_posix()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")
