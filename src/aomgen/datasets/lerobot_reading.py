"""Reader of LeRobot datasets v2.1 and v3.0 that AOMGen wrote."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, lru_cache
from itertools import count
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from aomgen.datasets import lerobot_v3, lerobot_v21
from aomgen.datasets.features import TOLD, TOLD_FEATURES
from aomgen.datasets.lerobot_tables import CHUNK_FILES, SOURCE, image_key
from aomgen.datasets.selection import REMEDY, StoredDataset, StoredEpisode, chosen_space
from aomgen.errors import MalformedFileError, MissingFileError
from aomgen.io.artifact import read_json
from aomgen.io.images import decode_image
from aomgen.io.video import decode_frames

INFO_FILE: Final = "meta/info.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Location:
    """Location of an episode: numbers of its rows and frames within the files."""

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
        MalformedFileError: The `codebase_version` is unsupported, a file is damaged or lacks a feature, or the dataset
            was not written by AOMGen.
    """
    where = folder / INFO_FILE
    info = read_json(where)
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if version not in LOCATIONS:
        raise MalformedFileError(
            where, f"has codebase_version {version!r}, known are {' and '.join(LOCATIONS)}", REMEDY
        )
    try:
        features = info["features"]
        prefix = image_key("")
        shapes = {name.removeprefix(prefix): features[name]["shape"] for name in features if prefix in name}
        sizes = {name: (int(shape[1]), int(shape[0])) for name, shape in shapes.items()}
        videos = [name for name in sizes if features[image_key(name)]["dtype"] == "video"]
        train = int(info["splits"]["train"].split(":")[1])
        fps = int(info["fps"])
        locations = list(LOCATIONS[version](folder, videos, fps))
        if len(locations) != info["total_episodes"]:
            raise MalformedFileError(
                where, f"states {info['total_episodes']} episodes, not {len(locations)}", REMEDY
            )
        tasks = TASKS[version](folder)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise MalformedFileError(folder / "meta", f"is not complete ({error!r})", REMEDY) from error
    return StoredDataset(
        actions=chosen_space(features, where),
        sizes=sizes,
        episodes=_episodes(locations, tasks, sizes, train),
        video=bool(videos),
        images=TOLD not in features,
    )


def _locations_v3(folder: Path, videos: list[str], fps: int) -> Iterator[_Location]:
    for row in _read_episode_rows(folder):
        data = folder / lerobot_v3.DATA_PATH.format(
            chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
        )
        shown = {}
        for camera in videos:
            key = image_key(camera)
            path = lerobot_v3.VIDEO_PATH.format(
                video_key=key,
                chunk_index=row[f"videos/{key}/chunk_index"],
                file_index=row[f"videos/{key}/file_index"],
            )
            shown[camera] = (folder / path, round(row[f"videos/{key}/from_timestamp"] * fps))
        yield _Location(
            number=row["episode_index"],
            source_index=row[SOURCE],
            length=row["length"],
            table=data,
            row=row["dataset_from_index"],
            videos=shown,
        )


def _read_episode_rows(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of all files of the table of episodes, of which there is at least one."""
    for file in count():
        chunk, index = divmod(file, CHUNK_FILES)
        path = folder / lerobot_v3.EPISODES_PATH.format(chunk_index=chunk, file_index=index)
        if file > 0 and not path.is_file():
            return
        yield from _read_table(path).to_pylist()


def _locations_v21(folder: Path, videos: list[str], fps: int) -> Iterator[_Location]:
    row_number = 0
    for row in _read_lines(folder / "meta" / "episodes.jsonl"):
        number = row["episode_index"]
        where: dict[str, Any] = {"episode_chunk": number // CHUNK_FILES, "episode_index": number}
        path = lerobot_v21.VIDEO_PATH
        yield _Location(
            number=number,
            source_index=row[SOURCE],
            length=row["length"],
            table=folder / lerobot_v21.DATA_PATH.format(**where),
            row=row_number,
            videos={name: (folder / path.format(video_key=image_key(name), **where), 0) for name in videos},
        )
        row_number += row["length"]


def _tasks_v3(folder: Path) -> list[str]:
    table = _read_table(folder / lerobot_v3.TASKS_PATH)
    # The instructions are in the index column of the pandas format.
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


# Readers of the locations of episodes and of the instructions, by version.
TASKS: Final = {lerobot_v21.VERSION: _tasks_v21, lerobot_v3.VERSION: _tasks_v3}
LOCATIONS: Final = {lerobot_v21.VERSION: _locations_v21, lerobot_v3.VERSION: _locations_v3}


def _take(
    frames: Iterator[tuple[int, tuple[float, av.VideoFrame]]], start: int, count: int
) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames start .. start + count - 1 of a video whose numbered frames are read in order."""
    for number, (_, frame) in frames:
        if number >= start:
            yield np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8)
        if number >= start + count - 1:
            return


def _episodes(
    locations: list[_Location], tasks: list[str], sizes: dict[str, tuple[int, int]], train: int
) -> Iterator[StoredEpisode]:
    opened, read_table = cache(lambda path: enumerate(decode_frames(path))), lru_cache(maxsize=1)(_read_table)
    for location in locations:
        table = read_table(location.table)
        for name in ("index", "task_index"):
            if name not in table.column_names:
                raise MalformedFileError(location.table, f"lacks the feature '{name}'", REMEDY)
        rows = pc.index(table["index"], location.row).as_py()
        table = table.slice(rows, location.length) if rows >= 0 else table.slice(0, 0)
        if table["index"].to_pylist() != list(range(location.row, location.row + location.length)):
            raise MalformedFileError(
                location.table, f"contains the wrong rows for episode {location.number}", REMEDY
            )
        columns, images = _columns(table), {}
        task = int(columns["task_index"][0])
        if not 0 <= task < len(tasks):
            raise MalformedFileError(location.table, f"names task {task} of {len(tasks)}", REMEDY)
        for camera in sizes:
            if camera in location.videos:
                video, start = location.videos[camera]
                images[camera] = _take(opened(video), start, location.length)
            else:
                images[camera] = _images(table, image_key(camera), location.table)
        yield StoredEpisode(
            source_index=location.source_index,
            split="train" if location.number < train else "val",
            instruction=tasks[task],
            columns=columns,
            images=images,
        )


def _columns(table: pa.Table) -> dict[str, NDArray[Any]]:
    """Return the numeric columns (T, D) or (T,) of a table by feature."""
    numeric = [name for name in table.column_names if not pa.types.is_struct(table.schema.field(name).type)]
    columns = {str(name): np.array(table[name].to_pylist()) for name in numeric}
    told = next((name for name in TOLD_FEATURES.values() if name not in columns), TOLD)
    return {told if name == TOLD else name: values for name, values in columns.items()}


def _images(table: pa.Table, feature: str, where: Path) -> Iterator[NDArray[np.uint8]]:
    if feature not in table.column_names:
        raise MalformedFileError(where, f"lacks the feature '{feature}'", REMEDY)
    for image in table[feature]:
        yield decode_image(image["bytes"].as_py(), where)


def _read_table(path: Path) -> pa.Table:
    if not path.is_file():
        raise MissingFileError(path, "is missing", REMEDY)
    try:
        return pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        raise MalformedFileError(path, f"is not readable parquet ({error})", REMEDY) from error
