"""The descriptive files of LeRobot v3.0: info.json, tasks.parquet and the path templates."""

import json
from collections.abc import Sequence
from typing import Any, Final

import pyarrow as pa

from aomgen.core.episode import Episode
from aomgen.datasets.features import feature_names

VERSION: Final = "v3.0"
CHUNK_FILES: Final = 1000  # files in a folder, the default of the format
DATA_FILE_MB: Final = 100  # [MB], the default of the format
VIDEO_FILE_MB: Final = 200  # [MB], the default of the format
DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
INDEX_TYPES: Final = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def video_key(camera: str) -> str:
    """Feature name of a camera's pictures."""
    return f"observation.images.{camera}"


def dataset_info(first: Episode, episodes: int, tasks: int, frames: int) -> dict[str, Any]:
    """Content of info.json of a dataset whose episodes are all like `first`."""
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(names)], "names": list(names)}
        for name, names in feature_names(first).items()
    }
    for camera in sorted(first.cameras):
        height, width = first.cameras[camera].height, first.cameras[camera].width
        features[video_key(camera)] = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height,
                "video.width": width,
                "video.codec": "h264",
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


def task_table(tasks: Sequence[str]) -> pa.Table:
    """The tasks as pandas would store a frame indexed by the sentence; LeRobot reads it so."""
    index = "__index_level_0__"

    def column(
        name: str | None, field: str | None, kind: str, numpy_kind: str, metadata: Any
    ) -> dict[str, Any]:
        return {
            "name": name,
            "field_name": field,
            "pandas_type": kind,
            "numpy_type": numpy_kind,
            "metadata": metadata,
        }

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
