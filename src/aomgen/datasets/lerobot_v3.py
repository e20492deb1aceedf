"""Writer of LeRobot v3.0 datasets, based on pyarrow and PyAV only.

A dataset is a pure function of committed episodes: the same episodes result in the same bytes. `meta/` contains the
description, `data/` low-dimensional features and `videos/` images, with many episodes per file.

Source: the file layout of LeRobot's `codebase_version` v3.0.
"""

import json
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from aomgen.core.episode import Episode
from aomgen.core.progress import Progress, silent
from aomgen.datasets.features import check_length, resize_videos
from aomgen.datasets.lerobot_tables import (
    ASSET,
    CHUNK_FILES,
    SOURCE,
    describe,
    encode_images,
    episode_columns,
    episode_statistics,
    image_key,
    join_columns,
    parquet_table,
    tasks_of,
    write_parquet,
    write_plain_json,
)
from aomgen.datasets.selection import Choices, Selection, select_episodes, stage_dataset
from aomgen.io.atomic import scratch_folder, write_bytes
from aomgen.io.episode_folder import CommittedEpisode
from aomgen.io.video import concatenate_videos

VERSION: Final = "v3.0"
# Default file sizes of the format, [MB].
DATA_FILE_MB, VIDEO_FILE_MB = 100, 200
DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
TASKS_PATH: Final = "meta/tasks.parquet"
EPISODES_PATH: Final = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
Counts = dict[str, NDArray[np.int64]]


def write_lerobot_v3(
    episode_folders: Sequence[Path], folder: Path, choices: Choices = Choices(), progress: Progress = silent
) -> Selection:
    """Build a dataset from committed episodes, in the given order, with the training split first.

    Args:
        episode_folders: Folders that `io.episode_folder.commit_episode` wrote.
        folder: Folder of the dataset; an existing dataset is replaced.
        choices: Options of the dataset.
        progress: Called after every episode.

    Returns:
        The episodes that were written.

    Raises:
        MissingFileError, ConfigError, CorruptArtifactError: See `selection.select_episodes`; or the length of a video
            differs from its episode.
        StorageError: Writing to the disk failed.
    """
    selection = select_episodes(episode_folders, folder, choices)
    columns = episode_columns(selection)
    rows = [
        _episode_row(item.episode, table) for item, table in zip(selection.episodes, columns, strict=True)
    ]
    with stage_dataset(folder, selection) as staging:
        if choices.media == "video":
            counts = _write_videos(staging, selection, rows, progress)
            _write_data(staging, columns, rows)
        elif not choices.has_images:
            counts = [Counts() for _ in rows]
            _write_data(staging, columns, rows)
        else:
            counts = _write_data_with_images(staging, selection, columns, rows, progress)
        _complete_rows(rows, columns, counts)
        _write_episode_rows(staging, rows)
        write_parquet(staging / TASKS_PATH, _task_table(tasks_of(selection)))
        totals = {name: np.sum([count[name] for count in counts], 0) for name in counts[0]}
        statistics = dict(episode_statistics(join_columns(columns), totals))
        write_plain_json(staging / "meta" / "stats.json", statistics)
        write_plain_json(staging / "meta" / "info.json", _info(selection))
    return selection


def _episode_row(episode: Episode, table: dict[str, NDArray]) -> dict[str, Any]:
    first = int(table["index"][0])
    return {
        "episode_index": int(table["episode_index"][0]),
        "tasks": [episode.instruction],
        "length": len(episode),
        "dataset_from_index": first,
        "dataset_to_index": first + len(episode),
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        SOURCE: episode.index,
        ASSET: episode.asset,
    }


def _complete_rows(
    rows: list[dict[str, Any]], columns: list[dict[str, NDArray]], counts: list[Counts]
) -> None:
    for row, table, colors in zip(rows, columns, counts, strict=True):
        for name, statistics in episode_statistics(table, colors):
            row |= {f"stats/{name}/{kind}": numbers for kind, numbers in statistics.items()}


def _write_episode_rows(staging: Path, rows: list[dict[str, Any]]) -> None:
    """Write the table of episodes; all rows have about the same size."""
    size = pa.Table.from_pylist(rows[:1]).nbytes
    for file, members in enumerate(_members(assign_files([size] * len(rows), DATA_FILE_MB * 1e6))):
        chunk, index = divmod(file, CHUNK_FILES)
        place = {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": index}
        path = staging / EPISODES_PATH.format(chunk_index=chunk, file_index=index)
        write_parquet(path, pa.Table.from_pylist([rows[i] | place for i in members]))


def assign_files(sizes: Sequence[float], limit: float) -> list[int]:
    """Assign a file number to each item, so that no file with several items is larger than `limit`."""
    numbers, number, filled = [], 0, 0.0
    for size in sizes:
        if filled > 0 and not filled + size <= limit:
            number, filled = number + 1, 0.0
        filled += size
        numbers.append(number)
    return numbers


def _members(files: list[int]) -> list[list[int]]:
    """Return the numbers of the episodes in each file."""
    return [list(members) for _, members in groupby(range(len(files)), key=files.__getitem__)]


def _write_data(staging: Path, columns: list[dict[str, NDArray]], rows: list[dict[str, Any]]) -> None:
    files = assign_files([_bytes(table) for table in columns], DATA_FILE_MB * 1e6)
    for file, members in enumerate(_members(files)):
        table = parquet_table(join_columns([columns[i] for i in members]), {})
        _write_data_file(staging, file, table, [rows[i] for i in members])


def _write_data_with_images(
    staging: Path,
    selection: Selection,
    columns: list[dict[str, NDArray]],
    rows: list[dict[str, Any]],
    progress: Progress,
) -> list[Counts]:
    """Write tables with images; returns color counts (3, 256) by camera of each episode."""
    cameras = selection.episodes[0].episode.cameras.values()
    # The size of a file is unknown before it is written; the size of the uncompressed images is an upper bound.
    pixels = 3 * sum(camera.width * camera.height for camera in cameras)
    sizes = [_bytes(table) + len(table["index"]) * pixels for table in columns]
    counts: list[Counts] = []
    for file, members in enumerate(_members(assign_files(sizes, DATA_FILE_MB * 1e6))):
        encoded = []
        for i in members:
            images, colors = encode_images(selection.episodes[i])
            encoded.append(images)
            counts.append(colors)
            progress((i + 1) / len(rows), f"{i + 1} of {len(rows)}")
        joined = {name: [png for images in encoded for png in images[name]] for name in encoded[0]}
        table = parquet_table(join_columns([columns[i] for i in members]), joined)
        _write_data_file(staging, file, table, [rows[i] for i in members])
    return counts


def _bytes(table: dict[str, NDArray]) -> int:
    return sum(values.nbytes for values in table.values())


def _write_data_file(staging: Path, file: int, table: pa.Table, rows: list[dict[str, Any]]) -> None:
    chunk, index = divmod(file, CHUNK_FILES)
    write_parquet(staging / DATA_PATH.format(chunk_index=chunk, file_index=index), table)
    for row in rows:
        row |= {"data/chunk_index": chunk, "data/file_index": index}


def _write_videos(
    staging: Path, selection: Selection, rows: list[dict[str, Any]], progress: Progress
) -> list[Counts]:
    """Write all videos and complete `rows`; returns color counts (3, 256) by camera of each episode."""
    episodes: list[CommittedEpisode] = list(selection.episodes)
    with scratch_folder(staging.parent) as scratch:
        if selection.choices.size is not None:
            episodes = [resize_videos(item, scratch) for item in episodes]
        cameras = sorted(episodes[0].videos)
        for done, camera in enumerate(cameras):
            sizes = [item.videos[camera].stat().st_size for item in episodes]
            for file, members in enumerate(_members(assign_files(sizes, VIDEO_FILE_MB * 1e6))):
                _write_video_file(staging, camera, file, {i: episodes[i] for i in members}, rows)
            progress((done + 1) / len(cameras), camera)
    return [dict(sorted(item.color_counts.items())) for item in episodes]


def _write_video_file(
    staging: Path, camera: str, file: int, members: dict[int, CommittedEpisode], rows: list[dict[str, Any]]
) -> None:
    key, fps = image_key(camera), next(iter(members.values())).episode.fps
    data, lengths = concatenate_videos([item.videos[camera] for item in members.values()], fps)
    chunk, index = divmod(file, CHUNK_FILES)
    write_bytes(staging / VIDEO_PATH.format(video_key=key, chunk_index=chunk, file_index=index), data)
    start = 0
    for (i, item), length in zip(members.items(), lengths, strict=True):
        check_length(item, camera, length)
        rows[i] |= {
            f"videos/{key}/chunk_index": chunk,
            f"videos/{key}/file_index": index,
            f"videos/{key}/from_timestamp": start / fps,
            f"videos/{key}/to_timestamp": (start + length) / fps,
        }
        start += length


def _info(selection: Selection) -> dict[str, Any]:
    """Return the content of info.json."""
    paths = {
        "data_files_size_in_mb": DATA_FILE_MB,
        "video_files_size_in_mb": VIDEO_FILE_MB,
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if selection.choices.media == "video" else None,
    }
    return describe(selection, VERSION) | paths


def _task_table(tasks: Sequence[str]) -> pa.Table:
    """Make the table of tasks in the form of a pandas frame indexed by the instruction, as LeRobot expects it."""
    index = "__index_level_0__"

    def column(*values: Any) -> dict[str, Any]:
        return dict(zip(("name", "field_name", "pandas_type", "numpy_type", "metadata"), values, strict=True))

    pandas = {
        "index_columns": [index],
        "column_indexes": [column(None, None, "unicode", "object", {"encoding": "UTF-8"})],
        "columns": [
            column("task_index", "task_index", "int64", "int64", None),
            column(None, index, "unicode", "object", None),
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.3.0",
    }
    table = pa.table(
        {"task_index": pa.array(range(len(tasks)), pa.int64()), index: pa.array(tasks, pa.string())}
    )
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})
