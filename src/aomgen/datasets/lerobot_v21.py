"""Writer of LeRobot v2.1 datasets, which have a separate table and separate videos for each episode.

This version is older than v3.0, and the newest one that openpi reads.

Source: the file layout of LeRobot's `codebase_version` v2.1.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

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
    parquet_table,
    tasks_of,
    write_parquet,
    write_plain_json,
)
from aomgen.datasets.selection import Choices, Selection, select_episodes, stage_dataset
from aomgen.io.atomic import scratch_folder, write_bytes, write_text
from aomgen.io.episode_folder import CommittedEpisode
from aomgen.io.video import probe_video

VERSION: Final = "v2.1"
DATA_PATH: Final = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
VIDEO_PATH: Final = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
# Statistics that the format defines.
STATISTICS: Final = ("min", "max", "mean", "std", "count")


def write_lerobot_v21(
    episode_folders: Sequence[Path], folder: Path, choices: Choices = Choices(), progress: Progress = silent
) -> Selection:
    """Build a dataset from committed episodes; arguments, result and errors as `lerobot_v3.write_lerobot_v3`."""
    selection = select_episodes(episode_folders, folder, choices)
    episodes: list[dict[str, Any]] = []
    statistics: list[dict[str, Any]] = []
    with stage_dataset(folder, selection) as staging, scratch_folder(folder.parent) as scratch:
        for item, columns in zip(selection.episodes, episode_columns(selection), strict=True):
            number = len(episodes)
            where: dict[str, Any] = {"episode_chunk": number // CHUNK_FILES, "episode_index": number}
            images, counts = dict[str, list[bytes]](), dict[str, NDArray[np.int64]]()
            if choices.media == "video":
                shown = resize_videos(item, scratch) if choices.size is not None else item
                _write_videos(staging, shown, where)
                counts = shown.color_counts
            elif choices.media == "image":
                images, counts = encode_images(item)
            write_parquet(staging / DATA_PATH.format(**where), parquet_table(columns, images))
            statistics.append({"episode_index": number, "stats": _known(columns, counts)})
            episodes.append(_episode_line(item, number))
            progress((number + 1) / len(selection.episodes), f"{number + 1} of {len(selection.episodes)}")
        meta, tasks = staging / "meta", tasks_of(selection)
        _write_lines(meta / "episodes.jsonl", episodes)
        _write_lines(meta / "episodes_stats.jsonl", statistics)
        _write_lines(meta / "tasks.jsonl", [{"task_index": i, "task": task} for i, task in enumerate(tasks)])
        write_plain_json(meta / "info.json", _info(selection))
    return selection


def _write_videos(staging: Path, item: CommittedEpisode, where: dict[str, Any]) -> None:
    for camera, video in sorted(item.videos.items()):
        check_length(item, camera, probe_video(video).frames)
        path = staging / VIDEO_PATH.format(video_key=image_key(camera), **where)
        write_bytes(path, video.read_bytes())


def _known(
    columns: Mapping[str, NDArray], counts: Mapping[str, NDArray[np.int64]]
) -> dict[str, dict[str, list]]:
    return {
        name: {kind: numbers[kind] for kind in STATISTICS}
        for name, numbers in episode_statistics(columns, counts)
    }


def _episode_line(item: CommittedEpisode, number: int) -> dict[str, Any]:
    episode = item.episode
    return {
        "episode_index": number,
        "tasks": [episode.instruction],
        "length": len(episode),
        SOURCE: episode.index,
        ASSET: episode.asset,
    }


def _info(selection: Selection) -> dict[str, Any]:
    """Return the content of info.json."""
    episodes, video = len(selection.episodes), selection.choices.media == "video"
    cameras = len(selection.episodes[0].episode.cameras)
    return describe(selection, VERSION) | {
        "total_videos": episodes * cameras if video else 0,
        "total_chunks": -(-episodes // CHUNK_FILES),
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if video else None,
    }


def _write_lines(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write one JSON value per line."""
    write_text(path, "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows))
