"""Bounded JSON reading."""

import json
from pathlib import Path
from typing import Any

from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError

# Largest JSON file read, [bytes]: far above what a run writes.
MAX_BYTES = 64 << 20


def read_json(path: Path, *, max_bytes: int = MAX_BYTES) -> Any:
    """Parse a JSON file that holds no NaN or infinity.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError: As their names say.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "check the path")
    size = path.stat().st_size
    if not size <= max_bytes:
        raise LimitExceededError(path, f"has {size} bytes, limit {max_bytes}")
    try:
        return json.loads(path.read_text("utf-8"), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise MalformedFileError(path, f"is not valid JSON ({error})", "write it again") from error


def _refuse(name: str) -> float:
    raise ValueError(f"{name} is not allowed")
