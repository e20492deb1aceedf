"""Reuse of stored files whose content can be computed again: a damaged file causes one warning, and is then ignored."""

import os
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

from aomgen.errors import CorruptArtifactError, InputError, MalformedFileError
from aomgen.io.artifact import read_json

T = TypeVar("T")
# Errors of reading a stored file that is damaged: truncated, of another content, or unreadable.
DAMAGE: Final = (InputError, CorruptArtifactError, OSError)


class StoredFileWarning(RuntimeWarning):
    """A stored file cannot be reused or written; its content is computed again."""


def warn_of_file(path: object, problem: str, consequence: str = "it is computed again") -> None:
    """Issue one warning about a stored file."""
    warnings.warn(f"{path}: {problem}; {consequence}", StoredFileWarning, stacklevel=2)


def reuse(path: Path, read: Callable[[], T]) -> T | None:
    """Read a stored value that can be computed again.

    Args:
        path: File of the value.
        read: Function that reads and checks it.

    Returns:
        The value; None if the file is missing, or if it is damaged, of which the user is warned.
    """
    if not os.path.exists(path):
        return None
    try:
        return read()
    except DAMAGE as error:
        warn_of_file(path, f"cannot be reused ({getattr(error, 'problem', error)})")
        return None


def reuse_object(path: Path) -> dict[str, Any]:
    """Read a stored JSON object as `reuse` does; a missing or damaged one is empty."""
    return reuse(path, partial(_read_object, path)) or {}


def _read_object(path: Path) -> dict[str, Any]:
    found = read_json(path)
    if not isinstance(found, dict):
        raise MalformedFileError(path, "holds no JSON object")
    return found
