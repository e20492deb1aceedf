"""Reading RLDS datasets of our own back."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.datasets.array_record import read_array_record
from aomgen.datasets.rlds import SHARD_NAME, VERSION, Shards
from aomgen.datasets.stored import REMEDY, StoredDataset, StoredEpisode, chosen_space
from aomgen.datasets.tfrecord import Feature, decode_example, read_records
from aomgen.errors import MalformedFileError
from aomgen.io.artifact import read_json
from aomgen.io.images import decode_image

FEATURES_FILE: Final = f"{VERSION}/features.json"
STEPS, ABOUT = "steps/", "episode_metadata/"
READERS: Final = {"tfrecord": read_records, "array_record": read_array_record}
# Length of a feature at a step, by its name.
Widths = dict[str, int]


def read_rlds(folder: Path) -> StoredDataset:
    """Open a dataset.

    Raises:
        MissingFileError: A file is missing.
        MalformedFileError: A file is damaged, cut or lacks a feature.
    """
    where = folder / FEATURES_FILE
    widths: Widths = {}
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
    """Features by name, levels joined by points."""
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
    widths: Widths,
    sizes: dict[str, tuple[int, int]],
) -> Iterator[StoredEpisode]:
    for split, shards in lengths.items():
        for number, wanted in enumerate(shards):
            words = {"name": name, "split": split, "kind": kind, "shard": number, "shards": len(shards)}
            path = home / SHARD_NAME.format(**words)
            count = 0
            for record in READERS[kind](path):
                yield _episode(decode_example(record, path), path, split, widths, sizes)
                count += 1
            if count != wanted:
                raise MalformedFileError(
                    path, f"holds {count} episodes, dataset_info.json says {wanted}", REMEDY
                )


def _episode(
    features: dict[str, Feature],
    where: Path,
    split: str,
    widths: Widths,
    sizes: dict[str, tuple[int, int]],
) -> StoredEpisode:
    def get(key: str) -> Any:
        if key not in features:
            raise MalformedFileError(where, f"lacks the feature '{key}'", REMEDY)
        return features[key]

    def pictures(camera: str) -> Iterator[NDArray[np.uint8]]:
        for encoded in get(f"{STEPS}observation/{camera}"):
            yield decode_image(encoded, where)

    columns = {name: get(STEPS + name.replace(".", "/")) for name in widths}
    return StoredEpisode(
        source_index=int(get(f"{ABOUT}source_index")[0]),
        split=split,
        instruction=str(get(f"{STEPS}language_instruction")[0], "utf-8"),
        columns={name: np.reshape(values, (-1, widths[name])) for name, values in columns.items()},
        pictures={camera: pictures(camera) for camera in sizes},
    )
