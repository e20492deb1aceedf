"""Common parts of LeRobot's formats v2.1 and v3.0: columns of episodes, parquet tables, feature descriptions, statistics."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from aomgen.core.episode import Episode
from aomgen.datasets.features import (
    TOLD,
    TOLD_FEATURES,
    ActionSpace,
    column_statistics,
    count_colors,
    feature_columns,
    feature_names,
    image_statistics,
    read_images,
)
from aomgen.datasets.selection import Media, Selection
from aomgen.io.atomic import write_bytes, write_text
from aomgen.io.episode_folder import CommittedEpisode
from aomgen.io.images import encode_png

# Number of files in a folder, the default of the format.
CHUNK_FILES: Final = 1000
INDEX_TYPES: Final = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
# Axis names of an image feature.
IMAGE_AXES: Final = ("height", "width", "channels")
# Additional columns of the table of episodes: the number of an episode in its run, and its object.
SOURCE, ASSET = "aomgen/source_index", "aomgen/asset"
# Images (PNG) of a table by feature.
Images = Mapping[str, list[bytes]]


def image_key(camera: str) -> str:
    """Return the name of the feature with a camera's images."""
    return f"observation.images.{camera}"


def tasks_of(selection: Selection) -> list[str]:
    """Return the distinct instructions, in order."""
    return list(dict.fromkeys(item.episode.instruction for item in selection.episodes))


def episode_columns(selection: Selection) -> list[dict[str, NDArray]]:
    """Return the columns (T, D) float32 or (T,) of each episode."""
    tasks, start, result = tasks_of(selection), 0, []
    for number, item in enumerate(selection.episodes):
        episode, count = item.episode, len(item.episode)
        columns = single_precision_columns(episode, selection.choices.actions)
        table = {_make_stored_name(name, selection.choices.media): values for name, values in columns.items()}
        table["frame_index"] = np.arange(count)
        table["episode_index"] = np.full(count, number)
        table["index"] = np.arange(start, start + count)
        table["task_index"] = np.full(count, tasks.index(episode.instruction))
        result.append(table)
        start += count
    return result


def _make_stored_name(feature: str, media: Media) -> str:
    """Return the stored name of a feature; without images, another feature becomes an observation."""
    return TOLD if feature == TOLD_FEATURES.get(media) else feature


def single_precision_columns(episode: Episode, actions: ActionSpace) -> dict[str, NDArray]:
    """Compute the columns that depend only on the episode: features (T, D) and times (T,), float32."""
    columns = feature_columns(episode, actions) | {"timestamp": episode.times_s}
    return {name: values.astype(np.float32) for name, values in columns.items()}


def encode_images(item: CommittedEpisode) -> tuple[dict[str, list[bytes]], dict[str, NDArray[np.int64]]]:
    """Encode all images of an episode as PNG by feature; also returns color counts (3, 256) by camera."""
    encoded, counts = {}, {}
    for camera in sorted(item.episode.cameras):
        images = list(read_images(item, camera))
        encoded[image_key(camera)] = [encode_png(image) for image in images]
        counts[camera] = count_colors(images)
    return encoded, counts


def parquet_table(columns: Mapping[str, NDArray], images: Images) -> pa.Table:
    """Make a table of columns (T, D) and images that Hugging Face's `datasets` decodes."""
    arrays = {name: _arrow(values) for name, values in columns.items()}
    if not images:
        return pa.table(arrays)
    for name, encoded in images.items():
        paths = pa.nulls(len(encoded), pa.string())
        arrays[name] = pa.StructArray.from_arrays(
            [pa.array(encoded, pa.binary()), paths], names=["bytes", "path"]
        )
    described: dict[str, Any] = {name: _hugging_face_type(values) for name, values in columns.items()}
    described |= {name: {"_type": "Image"} for name in images}
    metadata = {"huggingface": json.dumps({"info": {"features": described}})}
    return pa.table(arrays).replace_schema_metadata(metadata)


def _arrow(values: NDArray) -> pa.Array:
    """Convert a column; features with one element are stored as plain numbers, as in LeRobot."""
    flat = pa.array(values.ravel(), pa.float32() if values.dtype == np.float32 else pa.int64())
    if values.ndim == 2 and values.shape[1] > 1:
        return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    return flat


def _hugging_face_type(values: NDArray) -> dict[str, Any]:
    value = {"dtype": str(values.dtype), "_type": "Value"}
    if values.ndim == 2 and values.shape[1] > 1:
        return {"feature": value, "length": values.shape[1], "_type": "Sequence"}
    return value


def episode_statistics(
    columns: Mapping[str, NDArray], counts: Mapping[str, NDArray[np.int64]]
) -> Iterator[tuple[str, dict[str, list]]]:
    """Yield the statistics of every feature of an episode, or of all episodes joined."""
    frames = len(columns["index"])
    for name, values in columns.items():
        yield name, column_statistics(values.reshape(frames, -1))
    for camera, levels in counts.items():
        yield image_key(camera), image_statistics(levels, frames)


def join_columns(columns: Sequence[Mapping[str, NDArray]]) -> dict[str, NDArray]:
    """Concatenate the columns of several episodes."""
    return {name: np.concatenate([table[name] for table in columns]) for name in columns[0]}


def describe(selection: Selection, version: str) -> dict[str, Any]:
    """Return the common content of info.json in both formats."""
    first, train = selection.episodes[0].episode, len(selection.train)
    splits = {"train": f"0:{train}"}
    if selection.val:
        splits["val"] = f"{train}:{len(selection.episodes)}"
    return {
        "codebase_version": version,
        "robot_type": first.robot,
        "total_episodes": len(selection.episodes),
        "total_frames": selection.frames,
        "total_tasks": len(tasks_of(selection)),
        "chunks_size": CHUNK_FILES,
        "fps": first.fps,
        "splits": splits,
        "features": _features(selection),
    }


def _features(selection: Selection) -> dict[str, Any]:
    item, choices = selection.episodes[0], selection.choices
    features: dict[str, Any] = {
        _make_stored_name(name, choices.media): {
            "dtype": "float32",
            "shape": [len(names)],
            "names": list(names),
        }
        for name, names in feature_names(item.episode, choices.actions).items()
    }
    for name, camera in sorted(item.episode.cameras.items()) if choices.has_images else ():
        feature = {
            "dtype": choices.media,
            "shape": [camera.height, camera.width, 3],
            "names": list(IMAGE_AXES),
        }
        if choices.media == "video":
            feature["info"] = {
                "video.height": camera.height,
                "video.width": camera.width,
                "video.codec": item.codec,
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False,
                "video.fps": item.episode.fps,
                "video.channels": 3,
                "has_audio": False,
            }
        features[image_key(name)] = feature
    for name, kind in INDEX_TYPES.items():
        features[name] = {"dtype": kind, "shape": [1], "names": None}
    return features


def write_plain_json(path: Path, content: Any) -> None:
    """Create a JSON file with its keys in the given order."""
    write_text(path, json.dumps(content, indent=4, allow_nan=False))


def write_parquet(path: Path, table: pa.Table) -> None:
    """Create a parquet file."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    write_bytes(path, sink.getvalue().to_pybytes())
