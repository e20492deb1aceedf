"""LeRobot v3.0 datasets, written with pyarrow and PyAV only.

A dataset is a pure function of committed episodes: the same episodes give the same bytes, and
a dataset can always be built again. `meta/` describes, `data/` holds the low-dimensional
features of many episodes a file, `videos/` the images of many episodes a file.

Source: the file layout of LeRobot's `codebase_version` v3.0.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from aomgen.core.episode import Episode
from aomgen.core.progress import Progress, silent
from aomgen.core.values import Array
from aomgen.datasets.features import (
    column_statistics,
    feature_columns,
    feature_names,
    image_statistics,
)
from aomgen.errors import ConfigError, CorruptArtifactError, MissingFileError
from aomgen.io.atomic import staged_folder, write_bytes, write_text
from aomgen.io.episode_folder import CommittedEpisode, read_episode
from aomgen.io.video import concatenate_videos

VERSION: Final = "v3.0"
# The format's defaults: files in a folder, and sizes of files, [MB].
CHUNK_FILES, DATA_FILE_MB, VIDEO_FILE_MB = 1000, 100, 200
DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
INDEX_TYPES: Final = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def write_lerobot_v3(
    episode_folders: Sequence[Path], folder: Path, progress: Progress = silent
) -> dict[str, int]:
    """Build a dataset from committed episodes, in the order given.

    Args:
        episode_folders: Folders that `io.episode_folder.commit_episode` wrote.
        folder: Becomes the dataset; replaced if it is there.
        progress: Called after every episode.

    Returns:
        How many "episodes" and "frames" were written.

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
    tasks = list(dict.fromkeys(item.episode.instruction for item in episodes))
    columns = _columns([item.episode for item in episodes], tasks)
    rows = [_episode_row(item.episode, table) for item, table in zip(episodes, columns, strict=True)]
    frames = sum(len(item.episode) for item in episodes)
    with staged_folder(folder) as staging:
        _write_data(staging, columns, rows)
        counts = _write_videos(staging, episodes, rows, progress)
        meta = staging / "meta"
        _write_parquet(meta / "episodes" / "chunk-000" / "file-000.parquet", pa.Table.from_pylist(rows))
        _write_parquet(meta / "tasks.parquet", _task_table(tasks))
        _write_json(meta / "stats.json", _statistics(columns, counts, frames))
        _write_json(meta / "info.json", _info(episodes[0], len(episodes), len(tasks), frames))
    return {"episodes": len(episodes), "frames": frames}


def _check_alike(item: CommittedEpisode, first: CommittedEpisode) -> None:
    def kind(committed: CommittedEpisode) -> dict[str, Any]:
        episode = committed.episode
        sizes = {name: (camera.width, camera.height) for name, camera in sorted(episode.cameras.items())}
        return {
            "fps": episode.fps,
            "robot": episode.robot,
            "joints": episode.joint_names,
            "cameras": sizes,
            "codec": committed.codec,
        }

    have, want = kind(item), kind(first)
    for name, value in have.items():
        if value != want[name]:
            raise ConfigError(
                item.folder, f"has {name} {value}, {first.folder.name} has {want[name]}", "export them apart"
            )


def _columns(episodes: list[Episode], tasks: list[str]) -> list[dict[str, NDArray]]:
    """Columns (T, D) float32 or (T,) of each episode."""
    start, result = 0, []
    for number, episode in enumerate(episodes):
        count = len(episode)
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
    return result


def _episode_row(episode: Episode, table: dict[str, NDArray]) -> dict[str, Any]:
    first = int(table["index"][0])
    row = {
        "episode_index": int(table["episode_index"][0]),
        "tasks": [episode.instruction],
        "length": len(episode),
        "dataset_from_index": first,
        "dataset_to_index": first + len(episode),
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        "aomgen/source_index": episode.index,
        "aomgen/asset": episode.asset,
    }
    for name, values in table.items():
        for kind, numbers in column_statistics(values.reshape(len(values), -1)).items():
            row[f"stats/{name}/{kind}"] = numbers
    return row


def assign_files(sizes: Sequence[float], limit: float) -> list[int]:
    """File number of each item when a file is closed before it would pass `limit`."""
    numbers, number, filled = [], 0, 0.0
    for size in sizes:
        if filled > 0 and not filled + size <= limit:
            number, filled = number + 1, 0.0
        filled += size
        numbers.append(number)
    return numbers


def _write_data(staging: Path, columns: list[dict[str, NDArray]], rows: list[dict[str, Any]]) -> None:
    files = assign_files([sum(v.nbytes for v in table.values()) for table in columns], DATA_FILE_MB * 1e6)
    for file in sorted(set(files)):
        members = [table for table, number in zip(columns, files, strict=True) if number == file]
        merged = {name: np.concatenate([table[name] for table in members]) for name in members[0]}
        chunk, index = divmod(file, CHUNK_FILES)
        path = staging / DATA_PATH.format(chunk_index=chunk, file_index=index)
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
        key = _video_key(camera)
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
            counts = item.color_counts[camera]
            totals[camera] += counts
            for kind, numbers in image_statistics(counts, len(item.episode)).items():
                rows[i][f"stats/{key}/{kind}"] = numbers
            progress((done + (i + 1) / len(episodes)) / len(cameras), f"{camera}: {i + 1} of {len(episodes)}")
    return totals


def _video_key(camera: str) -> str:
    return f"observation.images.{camera}"


def _check_length(item: CommittedEpisode, camera: str, length: int) -> None:
    if length != len(item.episode):
        raise CorruptArtifactError(
            item.videos[camera], f"has {length} frames, the episode {len(item.episode)}", "generate it again"
        )


def _statistics(
    columns: list[dict[str, NDArray]], counts: dict[str, NDArray[np.int64]], frames: int
) -> dict[str, Any]:
    """Content of stats.json."""
    statistics = {}
    for name in columns[0]:
        merged: Array = np.concatenate([table[name] for table in columns])
        statistics[name] = column_statistics(merged.reshape(len(merged), -1))
    for camera, levels in counts.items():
        statistics[_video_key(camera)] = image_statistics(levels, frames)
    return statistics


def _info(committed: CommittedEpisode, episodes: int, tasks: int, frames: int) -> dict[str, Any]:
    """Content of info.json of a dataset whose episodes are all like one of them."""
    first = committed.episode
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(names)], "names": list(names)}
        for name, names in feature_names(first).items()
    }
    for name, camera in sorted(first.cameras.items()):
        features[_video_key(name)] = {
            "dtype": "video",
            "shape": [camera.height, camera.width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": camera.height,
                "video.width": camera.width,
                "video.codec": committed.codec,
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False,
                "video.fps": first.fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }
    for name, kind in INDEX_TYPES.items():
        features[name] = {"dtype": kind, "shape": [1], "names": None}
    return {
        "codebase_version": VERSION,
        "robot_type": first.robot,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": DATA_FILE_MB,
        "video_files_size_in_mb": VIDEO_FILE_MB,
        "fps": first.fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": features,
    }


def _task_table(tasks: Sequence[str]) -> pa.Table:
    """The tasks as pandas would store a frame indexed by the sentence; LeRobot reads it so."""
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


def _write_json(path: Path, content: dict[str, Any]) -> None:
    write_text(path, json.dumps(content, indent=4, allow_nan=False))


def _write_parquet(path: Path, table: pa.Table) -> None:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    write_bytes(path, sink.getvalue().to_pybytes())
