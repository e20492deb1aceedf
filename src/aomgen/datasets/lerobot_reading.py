"""Reading LeRobot datasets of our own back, v2.1 and v3.0."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from aomgen.datasets import lerobot_v3, lerobot_v21
from aomgen.datasets.features import OBJECT_POSE, TOLD
from aomgen.datasets.lerobot_tables import CHUNK_FILES, SOURCE, picture_key
from aomgen.datasets.stored import REMEDY, StoredDataset, StoredEpisode, chosen_space
from aomgen.errors import MalformedFileError, MissingFileError
from aomgen.io.artifact import read_json
from aomgen.io.images import decode_image
from aomgen.io.video import decode_frames

INFO_FILE: Final = "meta/info.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Place:
    """Where an episode's rows and frames lie: row and frame numbers within the files."""

    number: int
    source_index: int
    length: int
    table: Path
    row: int
    videos: dict[str, tuple[Path, int]] = field(default_factory=dict)


def read_lerobot(folder: Path) -> StoredDataset:
    """Open a dataset.

    Raises:
        MissingFileError: A file is missing.
        MalformedFileError: Another `codebase_version`, a file is damaged or lacks a feature, or the
            dataset is not of AOMGen's making.
    """
    where = folder / INFO_FILE
    info = read_json(where)
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if version not in PLACES:
        raise MalformedFileError(
            where, f"has codebase_version {version!r}, known are {' and '.join(PLACES)}", REMEDY
        )
    try:
        features = info["features"]
        prefix = picture_key("")
        shapes = {name.removeprefix(prefix): features[name]["shape"] for name in features if prefix in name}
        sizes = {name: (int(shape[1]), int(shape[0])) for name, shape in shapes.items()}
        videos = [name for name in sizes if features[picture_key(name)]["dtype"] == "video"]
        train = int(info["splits"]["train"].split(":")[1])
        fps = int(info["fps"])
        places = list(PLACES[version](folder, videos, fps))
        if len(places) != info["total_episodes"]:
            raise MalformedFileError(
                where, f"says {info['total_episodes']} episodes, not {len(places)}", REMEDY
            )
        tasks = TASKS[version](folder)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise MalformedFileError(folder / "meta", f"is not complete ({error!r})", REMEDY) from error
    return StoredDataset(
        actions=chosen_space(features, where),
        sizes=sizes,
        episodes=_episodes(places, tasks, sizes, train),
        video=bool(videos),
        pictures=TOLD not in features,
    )


def _places_v3(folder: Path, videos: list[str], fps: int) -> Iterator[_Place]:
    for row in _read_table(folder / lerobot_v3.EPISODES_PATH).to_pylist():
        data = folder / lerobot_v3.DATA_PATH.format(
            chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
        )
        shown = {}
        for camera in videos:
            key = picture_key(camera)
            path = lerobot_v3.VIDEO_PATH.format(
                video_key=key,
                chunk_index=row[f"videos/{key}/chunk_index"],
                file_index=row[f"videos/{key}/file_index"],
            )
            shown[camera] = (folder / path, round(row[f"videos/{key}/from_timestamp"] * fps))
        yield _Place(
            number=row["episode_index"],
            source_index=row[SOURCE],
            length=row["length"],
            table=data,
            row=row["dataset_from_index"],
            videos=shown,
        )


def _places_v21(folder: Path, videos: list[str], fps: int) -> Iterator[_Place]:
    row_number = 0
    for row in _read_lines(folder / "meta" / "episodes.jsonl"):
        number = row["episode_index"]
        where: dict[str, Any] = {"episode_chunk": number // CHUNK_FILES, "episode_index": number}
        path = lerobot_v21.VIDEO_PATH
        yield _Place(
            number=number,
            source_index=row[SOURCE],
            length=row["length"],
            table=folder / lerobot_v21.DATA_PATH.format(**where),
            row=row_number,
            videos={name: (folder / path.format(video_key=picture_key(name), **where), 0) for name in videos},
        )
        row_number += row["length"]


def _tasks_v3(folder: Path) -> list[str]:
    table = _read_table(folder / lerobot_v3.TASKS_PATH)
    # The sentences stand in the column that pandas makes of an index.
    rows = {
        number: task for number, task in zip(*(column.to_pylist() for column in table.columns), strict=True)
    }
    return [rows[number] for number in range(len(rows))]


def _tasks_v21(folder: Path) -> list[str]:
    rows = {row["task_index"]: row["task"] for row in _read_lines(folder / "meta" / "tasks.jsonl")}
    return [rows[number] for number in range(len(rows))]


def _read_lines(path: Path) -> list[Any]:
    if not path.is_file():
        raise MissingFileError(path, "is missing", REMEDY)
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()]


# How each version says where its episodes lie, and which instructions there are.
TASKS: Final = {lerobot_v21.VERSION: _tasks_v21, lerobot_v3.VERSION: _tasks_v3}
PLACES: Final = {lerobot_v21.VERSION: _places_v21, lerobot_v3.VERSION: _places_v3}


# Frames of a video with their numbers; taken in order.
_Frames = Iterator[tuple[int, tuple[float, av.VideoFrame]]]


def _open_video(path: Path) -> _Frames:
    return enumerate(decode_frames(path))


def _take(frames: _Frames, start: int, count: int) -> Iterator[NDArray[np.uint8]]:
    """The frames start .. start + count - 1; those before are passed over."""
    for number, (_, frame) in frames:
        if number >= start:
            yield np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8)
        if number >= start + count - 1:
            return


def _episodes(
    places: list[_Place], tasks: list[str], sizes: dict[str, tuple[int, int]], train: int
) -> Iterator[StoredEpisode]:
    opened, read_table = cache(_open_video), lru_cache(maxsize=1)(_read_table)
    for place in places:
        table = read_table(place.table)
        for name in ("index", "task_index"):
            if name not in table.column_names:
                raise MalformedFileError(place.table, f"lacks the feature '{name}'", REMEDY)
        rows = pc.index(table["index"], place.row).as_py()
        table = table.slice(rows, place.length) if rows >= 0 else table.slice(0, 0)
        if table["index"].to_pylist() != list(range(place.row, place.row + place.length)):
            raise MalformedFileError(place.table, f"holds other rows for episode {place.number}", REMEDY)
        columns, pictures = _columns(table), {}
        task = int(columns["task_index"][0])
        if not 0 <= task < len(tasks):
            raise MalformedFileError(place.table, f"names task {task} of {len(tasks)}", REMEDY)
        for camera in sizes:
            if camera in place.videos:
                video, start = place.videos[camera]
                pictures[camera] = _take(opened(video), start, place.length)
            else:
                pictures[camera] = _pictures(table, picture_key(camera), place.table)
        yield StoredEpisode(
            source_index=place.source_index,
            split="train" if place.number < train else "val",
            instruction=tasks[task],
            columns=columns,
            pictures=pictures,
        )


def _columns(table: pa.Table) -> dict[str, NDArray[Any]]:
    """Numbers (T, D) or (T,) of a table by feature."""
    numeric = [name for name in table.column_names if not pa.types.is_struct(table.schema.field(name).type)]
    columns = {str(name): np.array(table[name].to_pylist()) for name in numeric}
    return {OBJECT_POSE if name == TOLD else name: values for name, values in columns.items()}


def _pictures(table: pa.Table, feature: str, where: Path) -> Iterator[NDArray[np.uint8]]:
    if feature not in table.column_names:
        raise MalformedFileError(where, f"lacks the feature '{feature}'", REMEDY)
    for picture in table[feature]:
        yield decode_image(picture["bytes"].as_py(), where)


def _read_table(path: Path) -> pa.Table:
    if not path.is_file():
        raise MissingFileError(path, "is missing", REMEDY)
    try:
        return pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        raise MalformedFileError(path, f"is not readable parquet ({error})", REMEDY) from error
