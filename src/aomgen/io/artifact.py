"""Storage of frozen dataclasses by their annotations: `NAME.json`, and large arrays in `NAME.npz`.

Equal values give equal bytes. The size of files that are read is limited, no code in them is executed, and their values
must match the annotations.
"""

import hashlib
import io
import json
import types
import zipfile
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError
from aomgen.io.atomic import write_bytes, write_json

# Arrays of at most this many elements are stored in the JSON file, where they can be read without a program.
INLINE_ELEMENTS = 64
# Largest npz file that is read, [bytes]; a run writes far smaller ones, and this size fits into memory.
MAX_NPZ_BYTES: Final = 2 << 30
# Largest JSON file that is read, [bytes], chosen in the same manner.
MAX_JSON_BYTES: Final = 64 << 20
# Largest list of the episodes, samples or files of a run, [bytes]: a run may have 100,000 episodes.
MAX_LIST_BYTES: Final = 1 << 30
T = TypeVar("T")


def save_artifact(folder: Path, name: str, value: Any) -> None:
    """Write a dataclass of arrays, numbers, strings, None, tuples, mappings and dataclasses.

    Args:
        folder: Folder of the files.
        name: Name of the files without suffix.
        value: Dataclass instance.

    Raises:
        StorageError: Writing to the disk failed.
    """
    arrays: dict[str, NDArray[Any]] = {}
    content = _pack(value, "", arrays)
    if arrays:
        write_bytes(folder / f"{name}.npz", npz_bytes(arrays))
    write_json(folder / f"{name}.json", {"type": type(value).__name__, "value": content})


def load_artifact(folder: Path, name: str, kind: type[T]) -> T:
    """Read a value that `save_artifact` wrote.

    Args:
        folder: Folder of a finished stage.
        name: Name of the files without suffix.
        kind: Class of the value.

    Raises:
        MissingFileError, LimitExceededError: The file is missing or too large.
        MalformedFileError: The files are damaged or hold no value of this class.
    """
    path = folder / f"{name}.json"
    stored = read_json(path)
    remedy = "run the stage again"
    if not isinstance(stored, dict) or stored.get("type") != kind.__name__:
        raise MalformedFileError(path, f"holds no {kind.__name__}", remedy)
    arrays_file = folder / f"{name}.npz"
    arrays = read_npz(arrays_file) if arrays_file.is_file() else {}
    try:
        return _unpack(kind, stored.get("value"), arrays)
    except (TypeError, ValueError) as error:
        raise MalformedFileError(path, f"holds no {kind.__name__} ({error})", remedy) from error


def artifact_digest(value: Any) -> str:
    """Compute the SHA-256 digest of a value that `save_artifact` can store, as hexadecimal digits."""
    arrays: dict[str, NDArray[Any]] = {}
    content = _pack(value, "", arrays)
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    for name, array in arrays.items():
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def restore(kind: type[T], data: Any) -> T:
    """Build a value of the class `kind` from JSON values, as `save_artifact` or `asdict` create them from a value.

    Arrays must be lists; references to an npz file are refused.

    Raises:
        TypeError, ValueError: The JSON values do not match the annotations of the class.
    """
    return _unpack(kind, data, {})


def _pack(value: Any, key: str, arrays: dict[str, NDArray[Any]]) -> Any:
    if isinstance(value, np.ndarray):
        # JSON has no infinities and cannot represent the shape of an empty array.
        if value.ndim and 0 < value.size <= INLINE_ELEMENTS and np.isfinite(value).all():
            return value.tolist()
        name = key.removesuffix(".")
        arrays[name] = value
        return {"array": name}
    if is_dataclass(value):
        return {
            item.name: _pack(getattr(value, item.name), f"{key}{item.name}.", arrays)
            for item in fields(value)
        }
    if isinstance(value, Mapping):
        return {name: _pack(item, f"{key}{name}.", arrays) for name, item in value.items()}
    if isinstance(value, tuple | list):
        return [_pack(item, f"{key}{index}.", arrays) for index, item in enumerate(value)]
    return value.item() if isinstance(value, np.generic) else value


def _unpack(kind: Any, data: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    origin, args = get_origin(kind), get_args(kind)
    if kind in (Any, object):
        return data
    if origin in (Union, types.UnionType):
        return _unpack_optional(args, data, arrays)
    if origin is np.ndarray or kind is np.ndarray:
        return _unpack_array(kind, data, arrays)
    if is_dataclass(kind):
        return _unpack_dataclass(kind, data, arrays)
    if origin is tuple:
        _require(isinstance(data, list), kind, data)
        kinds = [args[0]] * len(data) if args[-1] is Ellipsis else args
        return tuple(_unpack(item, value, arrays) for item, value in zip(kinds, data, strict=True))
    if origin in (dict, Mapping):
        _require(isinstance(data, dict), kind, data)
        return {name: _unpack(args[1], value, arrays) for name, value in data.items()}
    if origin is Literal:
        _require(data in args, kind, data)
        return data
    if kind is float:
        _require(isinstance(data, int | float) and not isinstance(data, bool), kind, data)
        return float(data)
    _require(type(data) is kind, kind, data)
    return data


def _unpack_optional(kinds: tuple[Any, ...], data: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    if data is None and type(None) in kinds:
        return None
    (kind,) = (item for item in kinds if item is not type(None))
    return _unpack(kind, data, arrays)


def _unpack_array(kind: Any, data: Any, arrays: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    # NDArray[np.uint8] is ndarray[shape, dtype[np.uint8]].
    dtype = get_args(get_args(kind)[1])[0]
    if isinstance(data, dict):
        _require(data.get("array") in arrays, kind, data)
        return np.asarray(arrays[data["array"]], None if dtype is Any else dtype)
    _require(isinstance(data, list), kind, data)
    return np.asarray(data, dtype)


def _unpack_dataclass(kind: Any, data: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    hints = get_type_hints(kind)
    names = [item.name for item in fields(kind)]
    _require(isinstance(data, dict), kind, data)
    if set(data) != set(names):
        differing = ", ".join(sorted(set(data) ^ set(names)))
        raise ValueError(f"{kind.__name__} has other fields: {differing}")
    return kind(**{name: _unpack(hints[name], data[name], arrays) for name in names})


def _require(fits: bool, kind: Any, data: Any) -> None:
    if not fits:
        wanted = getattr(kind, "__name__", str(kind))
        raise ValueError(f"{str(data)[:60]} is not a {wanted}")


def npz_bytes(arrays: Mapping[str, NDArray[Any]], *, packed: bool = False) -> bytes:
    """Build the content of an npz file.

    Args:
        arrays: Arrays by name; the file has their order.
        packed: Compress the arrays.

    Returns:
        Content of the file; equal arrays give equal bytes, because the dates of the entries are fixed.
    """
    buffer = io.BytesIO()
    # The fastest compression level already reduces images of depth and labels by a factor of 5 to 50.
    with zipfile.ZipFile(buffer, "w", compresslevel=1) as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(array, order="C"), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED
            archive.writestr(entry, content.getvalue())
    return buffer.getvalue()


def arrays_from_bytes(data: bytes, where: Path) -> dict[str, NDArray[Any]]:
    """Read all arrays, by name, from the content of an npz file; `where` names the file in messages.

    Raises:
        MalformedFileError: The content is not an npz file, is damaged, or holds Python objects.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, KeyError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise MalformedFileError(where, f"is not a readable npz ({error})", "run the stage again") from error


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Read all arrays of an npz file, by name.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError: The file is missing, malformed or too large.
    """
    _check_size(path, MAX_NPZ_BYTES, "run the stage again")
    return arrays_from_bytes(path.read_bytes(), path)


def file_digest(path: Path) -> str:
    """Compute the SHA-256 digest of a file's content, as hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_json(path: Path, max_bytes: int = MAX_JSON_BYTES) -> Any:
    """Parse a JSON file of at most `max_bytes` that holds no NaN or infinity.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError: The file is missing, malformed or too large.
    """
    _check_size(path, max_bytes, "check the path")
    try:
        return json.loads(path.read_text("utf-8"), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise MalformedFileError(path, f"is not valid JSON ({error})", "write it again") from error


def _check_size(path: Path, max_bytes: int, absent: str) -> None:
    if not path.is_file():
        raise MissingFileError(path, "is missing", absent)
    size = path.stat().st_size
    if not size <= max_bytes:
        raise LimitExceededError(path, f"has {size} bytes, limit {max_bytes}")


def _refuse(name: str) -> float:
    raise ValueError(f"{name} is not allowed")
