"""Load an RLDS dataset with TensorFlow Datasets, decoded and as OpenVLA reads it: tfds_reader.py DATASET OUT.npz FRAME...

OpenVLA leaves steps undecoded, so that a step's features come as whole arrays and pictures as encoded bytes, and
computes its statistics over all splits.
"""

import json
import os
import sys
from pathlib import Path

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
import numpy as np
import tensorflow as tf
import tensorflow_datasets as tfds


def flatten(tree: dict, prefix: str = "") -> dict:
    """Leaves by name, levels joined by points."""
    flat = {}
    for name, value in tree.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


def statistics(values: np.ndarray) -> dict:
    """As OpenVLA's loader computes it."""
    return {
        "mean": values.mean(0, dtype=np.float64).tolist(),
        "std": values.std(0, dtype=np.float64).tolist(),
        "max": values.max(0).tolist(),
        "min": values.min(0).tolist(),
        "q01": np.quantile(values, 0.01, axis=0).tolist(),
        "q99": np.quantile(values, 0.99, axis=0).tolist(),
    }


def main(root: Path, out: Path, chosen: list[int]) -> None:
    builder = tfds.builder(root.name, data_dir=root.parent)
    decoded, pictures, undecoded, splits, tasks, start = {}, {}, {}, {}, [], 0
    # One file after the other.
    order = tfds.ReadConfig(interleave_cycle_length=1)
    for split in ("train", "val"):
        whole = builder.as_dataset(split=split, read_config=order)
        raw = builder.as_dataset(
            split=split, read_config=order, decoders={"steps": tfds.decode.SkipDecoding()}
        )
        for episode, bare in zip(whole, raw, strict=True):
            splits.setdefault(split, []).append(int(episode["episode_metadata"]["source_index"]))
            arrays = flatten(bare["steps"])
            for number, step in enumerate(episode["steps"]):
                leaves = flatten(step)
                tasks.append(leaves.pop("language_instruction").numpy().decode())
                for name, value in leaves.items():
                    if value.dtype != tf.uint8:
                        decoded.setdefault(name, []).append(value.numpy())
                    elif start + number in chosen:
                        camera = name.removeprefix("observation.")
                        pictures.setdefault(camera, []).append(value.numpy())
                        again = tf.io.decode_image(arrays[name][number], expand_animations=False)
                        if not np.array_equal(again, value):
                            raise SystemExit(f"{name} differs when it is decoded later")
            start += number + 1
            for name, value in arrays.items():
                if value.dtype != tf.string:
                    undecoded.setdefault(name, []).append(value.numpy())
    for name, parts in undecoded.items():
        if not np.array_equal(np.concatenate(parts), np.stack(decoded[name])):
            raise SystemExit(f"{name} differs when steps are left undecoded")
    numbers = {name: np.stack(values) for name, values in decoded.items()}
    report = {
        "splits": splits,
        "tasks": [tasks[index] for index in chosen],
        "statistics": {
            "action": statistics(numbers["action"]),
            "proprio": statistics(numbers["observation.state"]),
        },
    }
    found = {f"numbers/{name}": values for name, values in numbers.items()}
    found |= {f"pictures/{name}": np.stack(values) / np.float32(255) for name, values in pictures.items()}
    np.savez(out, report=json.dumps(report), **found)


main(Path(sys.argv[1]), Path(sys.argv[2]), sorted(int(word) for word in sys.argv[3:]))
