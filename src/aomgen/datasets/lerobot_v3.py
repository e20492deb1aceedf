"""LeRobot v3.0 datasets, written with pyarrow and PyAV only.

A dataset is a pure function of committed episodes: the same episodes give the same bytes, and
a dataset can always be built again. `meta/` describes, `data/` holds the low-dimensional
features of many episodes a file, `videos/` the images of many episodes a file.

Source: the file layout of LeRobot's `codebase_version` v3.0.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from aomgen.core.progress import Progress, silent
from aomgen.core.values import Array
from aomgen.datasets.features import color_counts, column_statistics, feature_columns, image_statistics
from aomgen.datasets.lerobot_layout import (
    CHUNK_FILES,
    DATA_FILE_MB,
    DATA_PATH,
    VIDEO_FILE_MB,
    VIDEO_PATH,
    dataset_info,
    task_table,
    video_key,
)
from aomgen.errors import ConfigError, CorruptArtifactError, MissingFileError
from aomgen.io.atomic import staged_folder, write_bytes, write_text
from aomgen.io.episode_folder import CommittedEpisode, read_episode
from aomgen.io.video import read_video
from aomgen.io.video_concat import concatenate_videos

# Pixels of every fourth row and column of at most this many frames an episode enter the
# color statistics.
SAMPLED_FRAMES: Final = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetSummary:
    """What was written."""

    folder: Path
    episodes: int
    frames: int
    cameras: tuple[str, ...]


def write_lerobot_v3(
    episode_folders: Sequence[Path], folder: Path, progress: Progress = silent
) -> DatasetSummary:
    """Build a dataset from committed episodes, in the order given.

    Args:
        episode_folders: Folders that `io.episode_folder.commit_episode` wrote.
        folder: Becomes the dataset; replaced if it is there.
        progress: Called after every episode.

    Raises:
        MissingFileError: There is no episode.
        ConfigError: Episodes differ in rate, robot, joints or cameras.
        CorruptArtifactError: An episode's file is damaged, or a video has another length.
        StorageError: The disk refuses.
    """
    if not episode_folders:
        raise MissingFileError(folder, "there is no episode to write", "generate episodes first")
    episodes = [read_episode(path) for path in episode_folders]
    for item in episodes:
        _check_alike(item, episodes[0])
    with staged_folder(folder) as staging:
        columns, tasks = _columns(episodes)
        rows: list[dict[str, Any]] = [_episode_row(item, i, columns[i]) for i, item in enumerate(episodes)]
        _write_data(staging, episodes, columns, rows)
        counts = _write_videos(staging, episodes, rows, progress)
        _write_meta(staging, episodes, columns, tasks, rows, counts)
    frames = sum(len(item.episode) for item in episodes)
    return DatasetSummary(
        folder=folder, episodes=len(episodes), frames=frames, cameras=tuple(sorted(episodes[0].videos))
    )


def assign_files(sizes: Sequence[float], limit: float) -> list[int]:
    """File number of each item when a file is closed before it would pass `limit`."""
    numbers, number, filled = [], 0, 0.0
    for size in sizes:
        if filled > 0 and not filled + size <= limit:
            number, filled = number + 1, 0.0
        filled += size
        numbers.append(number)
    return numbers


def _check_alike(item: CommittedEpisode, first: CommittedEpisode) -> None:
    def kind(committed: CommittedEpisode) -> dict[str, Any]:
        episode = committed.episode
        sizes = {name: (camera.width, camera.height) for name, camera in sorted(episode.cameras.items())}
        return {"fps": episode.fps, "robot": episode.robot, "joints": episode.joint_names, "cameras": sizes}

    have, want = kind(item), kind(first)
    for name, value in have.items():
        if value != want[name]:
            raise ConfigError(
                item.folder, f"has {name} {value}, {first.folder.name} has {want[name]}", "export them apart"
            )


def _columns(episodes: list[CommittedEpisode]) -> tuple[list[dict[str, NDArray]], list[str]]:
    """Columns (T, D) float32 or (T,) of each episode, and the task sentences."""
    tasks = list(dict.fromkeys(item.episode.instruction for item in episodes))
    start, result = 0, []
    for number, item in enumerate(episodes):
        episode, count = item.episode, len(item.episode)
        table: dict[str, NDArray] = {
            name: values.astype(np.float32) for name, values in feature_columns(episode).items()
        }
        table["timestamp"] = episode.times_s.astype(np.float32)
        table["frame_index"] = np.arange(count)
        table["episode_index"] = np.full(count, number)
        table["index"] = np.arange(start, start + count)
        table["task_index"] = np.full(count, tasks.index(episode.instruction))
        result.append(table)
        start += count
    return result, tasks


def _episode_row(item: CommittedEpisode, number: int, table: dict[str, NDArray]) -> dict[str, Any]:
    first = int(table["index"][0])
    row = {
        "episode_index": number,
        "tasks": [item.episode.instruction],
        "length": len(item.episode),
        "dataset_from_index": first,
        "dataset_to_index": first + len(item.episode),
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        "aomgen/source_index": item.episode.index,
        "aomgen/asset": item.episode.asset,
    }
    for name, values in table.items():
        for kind, numbers in column_statistics(values.reshape(len(values), -1)).items():
            row[f"stats/{name}/{kind}"] = numbers
    return row


def _write_data(
    staging: Path,
    episodes: list[CommittedEpisode],
    columns: list[dict[str, NDArray]],
    rows: list[dict[str, Any]],
) -> None:
    sizes = [sum(values.nbytes for values in table.values()) for table in columns]
    files = assign_files(sizes, DATA_FILE_MB * 1e6)
    for file in sorted(set(files)):
        members = [table for table, number in zip(columns, files, strict=True) if number == file]
        merged = {name: np.concatenate([table[name] for table in members]) for name in members[0]}
        path = staging / DATA_PATH.format(chunk_index=file // CHUNK_FILES, file_index=file % CHUNK_FILES)
        _write_parquet(path, pa.table({name: _arrow(values) for name, values in merged.items()}))
    for row, number in zip(rows, files, strict=True):
        row["data/chunk_index"], row["data/file_index"] = divmod(number, CHUNK_FILES)


def _arrow(values: NDArray) -> pa.Array:
    """A column; a feature of one element is stored as plain numbers, as LeRobot does."""
    flat = pa.array(values.ravel(), pa.float32() if values.dtype == np.float32 else pa.int64())
    if values.ndim == 2 and values.shape[1] > 1:
        return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    return flat


def _write_videos(
    staging: Path, episodes: list[CommittedEpisode], rows: list[dict[str, Any]], progress: Progress
) -> dict[str, NDArray[np.int64]]:
    """Write all videos, complete the episodes' rows; returns color counts (3, 256) by camera."""
    cameras, fps = sorted(episodes[0].videos), episodes[0].episode.fps
    totals = {}
    for done, camera in enumerate(cameras):
        key = video_key(camera)
        files = assign_files([item.videos[camera].stat().st_size for item in episodes], VIDEO_FILE_MB * 1e6)
        for file in sorted(set(files)):
            members = [number for number, where in enumerate(files) if where == file]
            data, lengths = concatenate_videos([episodes[i].videos[camera] for i in members], fps)
            chunk, index = divmod(file, CHUNK_FILES)
            path = staging / VIDEO_PATH.format(video_key=key, chunk_index=chunk, file_index=index)
            write_bytes(path, data)
            start = 0
            for i, length in zip(members, lengths, strict=True):
                _check_length(episodes[i], camera, length)
                rows[i] |= {
                    f"videos/{key}/chunk_index": chunk,
                    f"videos/{key}/file_index": index,
                    f"videos/{key}/from_timestamp": start / fps,
                    f"videos/{key}/to_timestamp": (start + length) / fps,
                }
                start += length
        totals[camera] = np.zeros((3, 256), np.int64)
        for i, item in enumerate(episodes):
            frames = read_video(item.videos[camera]).frames_srgb
            step = max(len(frames) // SAMPLED_FRAMES, 1)
            counts = color_counts(frames[::step, ::4, ::4])
            totals[camera] += counts
            for kind, numbers in image_statistics(counts, len(frames)).items():
                rows[i][f"stats/{key}/{kind}"] = numbers
            progress((done + (i + 1) / len(episodes)) / len(cameras), f"{camera}: {i + 1} of {len(episodes)}")
    return totals


def _check_length(item: CommittedEpisode, camera: str, length: int) -> None:
    if length != len(item.episode):
        raise CorruptArtifactError(
            item.videos[camera], f"has {length} frames, the episode {len(item.episode)}", "generate it again"
        )


def _write_meta(
    staging: Path,
    episodes: list[CommittedEpisode],
    columns: list[dict[str, NDArray]],
    tasks: list[str],
    rows: list[dict[str, Any]],
    counts: dict[str, NDArray[np.int64]],
) -> None:
    meta = staging / "meta"
    frames = sum(len(item.episode) for item in episodes)
    _write_parquet(meta / "episodes" / "chunk-000" / "file-000.parquet", pa.Table.from_pylist(rows))
    _write_parquet(meta / "tasks.parquet", task_table(tasks))
    statistics = {}
    for name in columns[0]:
        merged: Array = np.concatenate([table[name] for table in columns])
        statistics[name] = column_statistics(merged.reshape(len(merged), -1))
    for camera, levels in counts.items():
        statistics[video_key(camera)] = image_statistics(levels, frames)
    write_text(meta / "stats.json", json.dumps(statistics, indent=4, allow_nan=False))
    write_text(
        meta / "info.json",
        json.dumps(
            dataset_info(episodes[0].episode, len(episodes), len(tasks), frames), indent=4, allow_nan=False
        ),
    )


def _write_parquet(path: Path, table: pa.Table) -> None:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    write_bytes(path, sink.getvalue().to_pybytes())
