"""Episodes of LeRobot datasets, v2.1 and v3.0, read with pyarrow and PyAV alone.

Source: the file layouts of LeRobot's `codebase_version` v2.1 and v3.0.
"""

import json
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from aomgen.core.values import Array
from aomgen.errors import (
    ConfigError,
    IncompleteCaptureError,
    LimitExceededError,
    MalformedFileError,
    MissingFileError,
    quote_error,
)
from aomgen.importers.camera_names import make_camera_name
from aomgen.importers.recorded import JointTable, RecordedEpisode, RecordedVideo, WrittenVideo
from aomgen.importers.video_writing import copy_span, encode_frames
from aomgen.io.images import decode_image
from aomgen.io.paths import resolve_inside

INFO_FILE: Final = "meta/info.json"
# v2.0 has the layout of v2.1; only the statistics differ.
OLD_VERSIONS: Final = ("v2.0", "v2.1")
NEW_VERSION: Final = "v3.0"
REMEDY: Final = "download or export the dataset again"
# Measured state of the robot; the columns of other features have the feature name as a prefix.
STATE: Final = "observation.state"
# Largest text file of a dataset's metadata, enough for a million episodes, [bytes].
MAX_BYTES: Final = 512 << 20
# Fields of a path template, for example `{episode_index:06d}`; `str.format` would also evaluate attributes.
_FIELD: Final = re.compile(r"\{(\w+)(?::0(\d)d)?\}")


def read_episode(folder: Path, number: int) -> RecordedEpisode:
    """Read the joints of one episode; its videos are copied later.

    Raises:
        ConfigError: The episode does not exist; the message states the number of episodes.
        MissingFileError, MalformedFileError, LimitExceededError: A file is missing, damaged, or too large.
    """
    try:
        info = json.loads(_read_text(folder / INFO_FILE))
        version = info["codebase_version"]
        if version not in (*OLD_VERSIONS, NEW_VERSION):
            raise MalformedFileError(
                folder / INFO_FILE, f"has codebase_version {version!r}, known are v2.1 and v3.0", REMEDY
            )
        total = int(info["total_episodes"])
        if not 0 <= number < total:
            raise ConfigError(
                "--episode", f"is {number}, but {folder} has {total} episodes", f"expected 0 .. {total - 1}"
            )
        row = _read_row_v3(folder, number) if version == NEW_VERSION else _read_row_v21(folder, info, number)
        names = {"episode_index": number} | {key.removeprefix("data/"): value for key, value in row.items()}
        data = _resolve(folder, info["data_path"], names)
        table = _read_rows(data, number)
        return RecordedEpisode(
            kind=f"LeRobot {version}",
            tables=(_read_joints(table, info["features"], data),),
            videos=tuple(_list_videos(folder, info, row, table, data)),
            instruction=_read_instruction(row),
        )
    except (
        LookupError,
        TypeError,
        ValueError,
        ArithmeticError,
        AttributeError,
        RecursionError,
        pa.ArrowException,
    ) as error:
        raise MalformedFileError(
            folder, f"is not a complete LeRobot dataset ({quote_error(error)})", REMEDY
        ) from error


def _read_text(path: Path) -> str:
    if not path.is_file():
        raise MissingFileError(path, "is missing", REMEDY)
    if not path.stat().st_size <= MAX_BYTES:
        raise LimitExceededError(path, f"is larger than {MAX_BYTES} bytes")
    return path.read_text("utf-8")


def _read_table(path: Path, **options: Any) -> pa.Table:
    try:
        return pq.read_table(path, **options)
    except (pa.ArrowException, OSError) as error:
        raise MalformedFileError(path, f"is not readable parquet ({quote_error(error)})", REMEDY) from error


def _resolve(folder: Path, template: str, values: dict[str, Any]) -> Path:
    """Return a path inside the dataset after substitution of the template's fields.

    Raises:
        MissingFileError, UnsafePathError: See `resolve_inside`.
        KeyError, ValueError: A field is unknown, or a value is not a number.
    """

    def fill(field: re.Match[str]) -> str:
        value = values[field[1]]
        return str(value) if field[2] is None else f"{int(value):0{int(field[2])}d}"

    return resolve_inside(folder, _FIELD.sub(fill, template), named_by=folder / INFO_FILE)


def _read_row_v3(folder: Path, number: int) -> dict[str, Any]:
    """Return the row of an episode in the tables of episodes, without its statistics."""
    for path in sorted((folder / "meta" / "episodes").rglob("*.parquet")):
        wanted = [name for name in _read_names(path) if not name.startswith("stats/")]
        table = _read_table(path, columns=wanted)
        at = pc.index(table["episode_index"], number).as_py()
        if at >= 0:
            return table.slice(at, 1).to_pylist()[0]
    raise MalformedFileError(folder / "meta" / "episodes", f"lacks episode {number}", REMEDY)


def _read_names(path: Path) -> list[str]:
    try:
        return pq.read_schema(path).names
    except (pa.ArrowException, OSError) as error:
        raise MalformedFileError(path, f"is not readable parquet ({quote_error(error)})", REMEDY) from error


def _read_row_v21(folder: Path, info: dict[str, Any], number: int) -> dict[str, Any]:
    path = folder / "meta" / "episodes.jsonl"
    for line in _read_text(path).splitlines():
        row = json.loads(line)
        if row["episode_index"] == number:
            return row | {"episode_chunk": number // int(info.get("chunks_size", 1000))}
    raise MalformedFileError(path, f"lacks episode {number}", REMEDY)


def _read_rows(path: Path, number: int) -> pa.Table:
    """Return the rows of one episode in the order of its frames."""
    table = _read_table(path)
    table = table.filter(pc.equal(table["episode_index"], number))
    if not len(table):
        raise IncompleteCaptureError(path, f"has no rows of episode {number}", REMEDY)
    return table.sort_by("frame_index")


def _read_joints(table: pa.Table, features: dict[str, Any], path: Path) -> JointTable:
    """Return the columns of all numeric measured features; the commanded values in `action` are excluded."""
    columns: dict[str, Array] = {}
    for feature, described in features.items():
        if feature.startswith("observation.") and described["dtype"] in ("float32", "float64"):
            values = np.array(table[feature].to_pylist(), np.float64).reshape(len(table), -1)
            prefix = "" if feature == STATE else f"{feature}."
            names = _list_names(described.get("names"), values.shape[1], feature)
            columns |= {f"{prefix}{name}": column for name, column in zip(names, values.T, strict=True)}
    return JointTable(
        name=path.name, times_s=np.array(table["timestamp"].to_pylist(), np.float64), columns=columns
    )


def _list_names(names: Any, count: int, feature: str) -> list[str]:
    """Return the names of a feature's elements; numbered names if the dataset has none.

    Datasets store names as a list, a list in a list, or a list in a table (`{"motors": [...]}`).
    """
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    elif isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        names = names[0]
    if isinstance(names, list) and len(names) == count and len(set(map(str, names))) == count:
        return [str(name) for name in names]
    return [feature if count == 1 else f"{feature}.{number}" for number in range(count)]


def _read_instruction(row: dict[str, Any]) -> str:
    tasks = row.get("tasks") or [""]
    return str(tasks[0]) if isinstance(tasks, list) else str(tasks)


def _list_videos(
    folder: Path, info: dict[str, Any], row: dict[str, Any], table: pa.Table, data: Path
) -> Iterator[RecordedVideo]:
    for feature, described in info["features"].items():
        if described["dtype"] == "image":
            write = partial(_write_images, table.select(["timestamp", feature]), feature, data)
        elif described["dtype"] == "video" and not (described.get("info") or {}).get("video.is_depth_map"):
            prefix = f"videos/{feature}/"
            names = row | {
                key.removeprefix(prefix): value for key, value in row.items() if key.startswith(prefix)
            }
            path = _resolve(folder, info["video_path"], names | {"video_key": feature})
            start_s, end_s = names.get("from_timestamp", -np.inf), names.get("to_timestamp", np.inf)
            write = partial(copy_span, path, start_s=float(start_s), end_s=float(end_s))
        else:
            continue
        yield RecordedVideo(name=make_camera_name(feature), source=feature, write=write)


def _write_images(table: pa.Table, feature: str, data: Path, target: Path) -> WrittenVideo:
    def decode() -> Iterator[tuple[float, NDArray[np.uint8]]]:
        for time_s, image in zip(table["timestamp"], table[feature], strict=True):
            content = image.as_py()
            if not isinstance(content, dict) or not content.get("bytes"):
                raise MalformedFileError(data, f"lacks an image of '{feature}'", REMEDY)
            yield float(time_s.as_py()), decode_image(content["bytes"], data)

    return encode_frames(decode(), target, f"{data}, {feature}")
