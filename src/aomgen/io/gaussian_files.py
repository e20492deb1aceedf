"""Gaussians in any known file format, chosen by the suffix."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from aomgen.core.gaussians import Gaussians
from aomgen.errors import ConfigError
from aomgen.io import ply, splat
from aomgen.io.ply import MAX_GAUSSIANS

F = TypeVar("F")
_READERS = {".ply": ply.read_gaussians, ".splat": splat.read_gaussians}
_WRITERS = {".ply": ply.write_gaussians, ".splat": splat.write_gaussians}


def read_gaussians(path: Path, *, max_gaussians: int = MAX_GAUSSIANS) -> Gaussians:
    """Read a 3DGS `.ply` or a `.splat` file.

    Raises:
        ConfigError: Another suffix.
        MissingFileError, LimitExceededError, MalformedFileError, NonFiniteError: See `io.ply` and
            `io.splat`.
    """
    return _choose(path, _READERS, "read")(path, max_gaussians=max_gaussians)


def write_gaussians(path: Path, gaussians: Gaussians) -> None:
    """Write a 3DGS `.ply` (exact), or a `.splat` (8 bits, one color).

    Raises:
        ConfigError: Another suffix.
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero.
        StorageError: The disk refuses.
    """
    _choose(path, _WRITERS, "written")(path, gaussians)


def _choose(path: Path, known: Mapping[str, F], what: str) -> F:
    if path.suffix.lower() not in known:
        raise ConfigError(
            path, f"has suffix {path.suffix!r}, {', '.join(known)} can be {what}", "rename or convert it"
        )
    return known[path.suffix.lower()]
