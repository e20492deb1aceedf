"""Reader and writer of RLDS datasets for OpenVLA, in the layout of TensorFlow Datasets (TFDS), without TensorFlow.

`FOLDER/1.0.0/` contains features.json, dataset_info.json and the shards of the splits `train` and `val`, so that
`tfds.builder(FOLDER's name, data_dir=FOLDER's parent)` finds it. An episode is one record.

The columns differ from those of the other formats, see `openvla_columns`.

Source: TFDS's documentation "RLDS"; OpenVLA's `prismatic/vla/datasets/rlds/oxe` for the encodings.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from aomgen.core.episode import Episode
from aomgen.core.progress import Progress, silent
from aomgen.core.transforms import invert
from aomgen.core.values import Array
from aomgen.datasets.features import ActionSpace, feature_columns, last_targets, read_images
from aomgen.datasets.records import (
    Feature,
    decode_example,
    encode_example,
    read_array_record,
    read_records,
    records_bytes,
    require_array_record,
    write_array_record,
)
from aomgen.datasets.selection import (
    REMEDY,
    Choices,
    Selection,
    StoredDataset,
    StoredEpisode,
    chosen_space,
    select_episodes,
    stage_dataset,
)
from aomgen.errors import ConfigError, MalformedFileError
from aomgen.io.artifact import read_json
from aomgen.io.atomic import write_bytes, write_json
from aomgen.io.episode_folder import CommittedEpisode
from aomgen.io.images import decode_image, encode_jpeg

VERSION: Final = "1.0.0"
# Number of episodes in a file (tens of megabytes), so that readers can shuffle several files.
SHARD_EPISODES: Final = 16
# Number of joints in OpenVLA's state; missing joints are zero.
STATE_JOINTS: Final = 7
# At least 36 dB on rendered images, even at 64x48.
JPEG_QUALITY: Final = 95
# File formats of shards, by their names in TFDS.
Shards = Literal["tfrecord", "array_record"]
SHARD_NAME: Final = "{name}-{split}.{kind}-{shard:05d}-of-{shards:05d}"
FILE_TEMPLATE: Final = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"
FEATURES_FILE: Final = f"{VERSION}/features.json"
STEPS, ABOUT = "steps/", "episode_metadata/"
READERS: Final = {"tfrecord": read_records, "array_record": read_array_record}
STATISTICS_FILE: Final = "dataset_statistics.json"
TFDS_NAME: Final = re.compile(r"[a-zA-Z]\w*")


def openvla_columns(episode: Episode, actions: ActionSpace = "ee_delta") -> dict[str, Array]:
    """Compute the columns (T, D) of the steps, by name; a dot in a name separates levels of nesting.

    The gripper of `action` and `observation.state` is 1 open .. 0 closed. `observation.state` contains seven joints
    (zero if the arm has fewer) and the gripper. `action` of the space "ee_delta" is the motion from the previous target
    to the target in the axes of the world: translation, then roll, pitch and yaw (`rpy_from_matrix`) of R_world_target
    @ inverse(R_world_last). Annotations are the same as in the other formats.

    Raises:
        ConfigError: The arm has more than seven joints.
    """
    joints = len(episode.joint_names)
    if not joints <= STATE_JOINTS:
        raise ConfigError(
            "--format rlds", f"holds {STATE_JOINTS} joints, the arm has {joints}", "choose another format"
        )
    columns = feature_columns(episode, actions)
    padding = np.zeros((len(episode), STATE_JOINTS - joints))
    columns["observation.state"] = np.column_stack([episode.joints, padding, 1 - episode.gripper])
    target = columns["action"][:, :-1]
    if actions == "ee_delta":
        target = world_deltas(last_targets(episode), episode.Ts_world_ee_action)
    columns["action"] = np.column_stack([target, 1 - episode.action_gripper])
    return columns


def world_deltas(Ts_world_last: Array, Ts_world_target: Array) -> Array:
    """Compute the motion (T, 6) from poses (T, 4, 4) to targets (T, 4, 4) in the axes of the world: [m], then [rad]."""
    turns = Ts_world_target[:, :3, :3] @ invert(Ts_world_last)[:, :3, :3]
    return np.column_stack([Ts_world_target[:, :3, 3] - Ts_world_last[:, :3, 3], rpy_from_matrix(turns)])


def rpy_from_matrix(R: Array) -> Array:
    """Compute roll, pitch and yaw (T, 3), [rad], with R = Rz(yaw) @ Ry(pitch) @ Rx(roll)."""
    roll = np.arctan2(R[:, 2, 1], R[:, 2, 2])
    pitch = np.arctan2(-R[:, 2, 0], np.hypot(R[:, 2, 1], R[:, 2, 2]))
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return np.column_stack([roll, pitch, yaw])


def write_rlds(
    episode_folders: Sequence[Path],
    folder: Path,
    choices: Choices,
    progress: Progress = silent,
    *,
    kind: Shards = "tfrecord",
) -> Selection:
    """Build a dataset from committed episodes; arguments, result and errors as `lerobot_v3.write_lerobot_v3`.

    Raises:
        BackendError: The library that writes these shards is not installed.
        ConfigError: The name of the folder is invalid for TFDS, or the validation split would be empty.
    """
    name = folder.name
    if not TFDS_NAME.fullmatch(name):
        raise ConfigError(
            folder, "is not a valid name for TFDS", "use letters, digits and _ in the folder's name"
        )
    if not choices.val:
        raise ConfigError(
            "--val",
            "is 0",
            "without a val split OpenVLA validates on 5 % of the training data; choose 1 or more",
        )
    if kind == "array_record":
        require_array_record()
    selection = select_episodes(episode_folders, folder, choices)
    splits, done = [], 0
    with stage_dataset(folder, selection) as staging:
        home = staging / VERSION
        for split, episodes in selection.splits.items():
            shards = [episodes[i : i + SHARD_EPISODES] for i in range(0, len(episodes), SHARD_EPISODES)]
            size = 0
            for number, members in enumerate(shards):
                records = [_record(item, choices.actions) for item in members]
                words = {"name": name, "split": split, "kind": kind, "shard": number, "shards": len(shards)}
                file = home / SHARD_NAME.format(**words)
                if kind == "array_record":
                    file.parent.mkdir(exist_ok=True)
                    write_array_record(file, records)
                else:
                    write_bytes(file, records_bytes(records))
                size += sum(map(len, records))
                done += len(members)
                progress(done / len(selection.episodes), f"{done} of {len(selection.episodes)}")
            lengths = [str(len(members)) for members in shards]
            splits.append(
                {
                    "name": split,
                    "numBytes": str(size),
                    "shardLengths": lengths,
                    "filepathTemplate": FILE_TEMPLATE,
                }
            )
        columns = [openvla_columns(item.episode, choices.actions) for item in selection.episodes]
        write_json(home / "features.json", _describe_features(selection.episodes[0], columns[0]))
        write_json(home / "dataset_info.json", _info(name, splits, kind))
        write_json(home / STATISTICS_FILE, {name: openvla_statistics(columns)})
    return selection


def openvla_statistics(columns: Sequence[Mapping[str, NDArray]]) -> dict[str, Any]:
    """Compute OpenVLA's normalization from the columns of all episodes, in double precision."""
    result: dict[str, Any] = {}
    for key, name in {"action": "action", "proprio": "observation.state"}.items():
        values = np.concatenate([table[name].astype(np.float32) for table in columns]).astype(np.float64)
        numbers = {"mean": values.mean(0), "std": values.std(0), "max": values.max(0), "min": values.min(0)}
        numbers |= {"q01": np.quantile(values, 0.01, axis=0), "q99": np.quantile(values, 0.99, axis=0)}
        result[key] = {kind: array.tolist() for kind, array in numbers.items()}
    frames = sum(len(table["action"]) for table in columns)
    return result | {"num_transitions": frames, "num_trajectories": len(columns)}


def _record(item: CommittedEpisode, actions: ActionSpace) -> bytes:
    episode = item.episode
    first, last = (np.arange(len(episode)) == frame for frame in (0, len(episode) - 1))
    steps: dict[str, Feature] = {
        name.replace(".", "/"): values for name, values in openvla_columns(episode, actions).items()
    }
    for camera in sorted(episode.cameras):
        images = read_images(item, camera)
        steps[f"observation/{camera}"] = [
            encode_jpeg(image, JPEG_QUALITY, halve_colors=False) for image in images
        ]
    steps |= {
        "is_first": first,
        "is_last": last,
        "is_terminal": last,
        "reward": last.astype(np.float32),
        "discount": np.ones(len(episode), np.float32),
        "language_instruction": [episode.instruction.encode()] * len(episode),
    }
    about: dict[str, Feature] = {
        "episode_metadata/file_path": [item.folder.name.encode()],
        "episode_metadata/source_index": np.array([episode.index]),
        "episode_metadata/asset": [episode.asset.encode()],
    }
    return encode_example({f"steps/{name}": value for name, value in steps.items()} | about)


def _describe_features(item: CommittedEpisode, columns: Mapping[str, NDArray]) -> dict[str, Any]:
    """Return the content of features.json."""
    step: dict[str, Any] = {
        name: _tensor({"dimensions": [str(values.shape[1])]}, "float32") for name, values in columns.items()
    }
    for name, camera in item.episode.cameras.items():
        shape = {"dimensions": [str(camera.height), str(camera.width), "3"]}
        image = {"shape": shape, "dtype": "uint8", "encodingFormat": "jpeg"}
        step[f"observation.{name}"] = _feature("image_feature.Image", image=image)
    step |= {name: _tensor({}, "bool") for name in ("is_first", "is_last", "is_terminal")}
    step |= {name: _tensor({}, "float32") for name in ("reward", "discount")}
    text = _feature("text_feature.Text", text={})
    step["language_instruction"] = text
    about = {"file_path": text, "source_index": _tensor({}, "int64"), "asset": text}
    steps = _feature("dataset_feature.Dataset", sequence={"feature": _nest(step), "length": "-1"})
    return _dictionary({"steps": steps, "episode_metadata": _dictionary(about)})


def _nest(features: Mapping[str, Any]) -> dict[str, Any]:
    """Nest features; the part of a name before a dot becomes a nested dictionary."""
    levels: dict[str, dict[str, Any]] = {}
    for name, feature in features.items():
        first, _, rest = name.partition(".")
        levels.setdefault(first, {})[rest] = feature
    return _dictionary({name: parts[""] if "" in parts else _nest(parts) for name, parts in levels.items()})


def _dictionary(features: Mapping[str, Any]) -> dict[str, Any]:
    return _feature("features_dict.FeaturesDict", featuresDict={"features": dict(features)})


def _tensor(shape: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """Describe a numeric tensor; a scalar if the shape is empty."""
    name = "tensor_feature.Tensor" if shape else "scalar.Scalar"
    return _feature(name, tensor={"shape": shape, "dtype": kind, "encoding": "none"})


def _feature(name: str, **content: Any) -> dict[str, Any]:
    return {"pythonClassName": f"tensorflow_datasets.core.features.{name}", **content}


def _info(name: str, splits: list[dict[str, Any]], kind: Shards) -> dict[str, Any]:
    """Return the content of dataset_info.json."""
    return {
        "name": name,
        "version": VERSION,
        "fileFormat": kind,
        "moduleName": "aomgen.datasets.rlds",
        "description": "Verified demonstrations of opening articulated objects.",
        "releaseNotes": {},
        "splits": splits,
    }


def read_rlds(folder: Path) -> StoredDataset:
    """Open a dataset.

    Raises:
        MissingFileError: A file is missing.
        MalformedFileError: A file is damaged or truncated, or lacks a feature.
    """
    where = folder / FEATURES_FILE
    widths: dict[str, int] = {}
    sizes: dict[str, tuple[int, int]] = {}
    try:
        features = read_json(where)["featuresDict"]["features"]
        steps = _flatten(features["steps"]["sequence"]["feature"])
        for name, feature in steps.items():
            if "image" in feature:
                height, width, _ = map(int, feature["image"]["shape"]["dimensions"])
                sizes[name.removeprefix("observation.")] = (width, height)
            elif feature.get("tensor", {}).get("shape"):
                widths[name] = int(feature["tensor"]["shape"]["dimensions"][0])
        info = read_json(where.with_name("dataset_info.json"))
        name, kind = str(info["name"]), info["fileFormat"]
        if kind not in READERS:
            raise ValueError(f"fileFormat '{kind}' is unknown")
        lengths = {split["name"]: list(map(int, split["shardLengths"])) for split in info["splits"]}
    except (KeyError, TypeError, ValueError) as error:
        raise MalformedFileError(where.parent, f"is not described completely ({error!r})", REMEDY) from error
    return StoredDataset(
        actions=chosen_space(widths, where),
        sizes=sizes,
        episodes=_episodes(where.parent, name, kind, lengths, widths, sizes),
    )


def _flatten(described: Any, prefix: str = "") -> dict[str, Any]:
    """Return features by name; levels are separated by dots."""
    if "featuresDict" not in described:
        return {prefix.removesuffix("."): described}
    flat: dict[str, Any] = {}
    for name, feature in described["featuresDict"]["features"].items():
        flat |= _flatten(feature, f"{prefix}{name}.")
    return flat


def _episodes(
    home: Path,
    name: str,
    kind: Shards,
    lengths: dict[str, list[int]],
    widths: dict[str, int],
    sizes: dict[str, tuple[int, int]],
) -> Iterator[StoredEpisode]:
    """Read the episodes; `widths` contains the length of each feature at a step."""
    for split, shards in lengths.items():
        for number, expected in enumerate(shards):
            words = {"name": name, "split": split, "kind": kind, "shard": number, "shards": len(shards)}
            path, count = home / SHARD_NAME.format(**words), 0
            for record in READERS[kind](path):
                try:
                    yield _episode(decode_example(record, path), path, split, widths, sizes)
                except KeyError as error:
                    raise MalformedFileError(path, f"lacks the feature {error}", REMEDY) from error
                count += 1
            if count != expected:
                raise MalformedFileError(
                    path, f"holds {count} episodes, dataset_info.json says {expected}", REMEDY
                )


def _episode(
    features: Mapping[str, Any],
    where: Path,
    split: str,
    widths: dict[str, int],
    sizes: dict[str, tuple[int, int]],
) -> StoredEpisode:
    columns = {name: features[STEPS + name.replace(".", "/")] for name in widths}
    encoded = {camera: features[f"{STEPS}observation/{camera}"] for camera in sizes}
    return StoredEpisode(
        source_index=int(features[f"{ABOUT}source_index"][0]),
        split=split,
        instruction=str(features[f"{STEPS}language_instruction"][0], "utf-8"),
        columns={name: np.reshape(values, (-1, widths[name])) for name, values in columns.items()},
        images={camera: (decode_image(item, where) for item in items) for camera, items in encoded.items()},
    )
