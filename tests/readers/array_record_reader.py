"""Load an RLDS dataset in ArrayRecord files as TFDS gives it to Grain: array_record_reader.py DATASET OUT.npz FRAME..."""

import json
import os
import sys
from pathlib import Path

os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
import numpy as np
import tensorflow_datasets as tfds


def flatten(tree: dict, prefix: str = "") -> dict:
    """Leaves by name, levels joined by points."""
    flat = {}
    for name, value in tree.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


def main(root: Path, out: Path, chosen: list[int]) -> None:
    builder = tfds.builder(root.name, data_dir=root.parent)
    found, splits, frame = {}, {}, 0
    for split in ("train", "val"):
        source = builder.as_data_source(split=split)
        # From any place on.
        last = source[len(source) - 1]["episode_metadata"]["source_index"]
        for episode in source:
            splits.setdefault(split, []).append(int(episode["episode_metadata"]["source_index"]))
            for step in episode["steps"]:
                leaves = flatten(step)
                del leaves["language_instruction"]
                for name, value in leaves.items():
                    if np.ndim(value) < 3:
                        found.setdefault(f"numbers/{name}", []).append(value)
                    elif frame in chosen:
                        camera = name.removeprefix("observation.")
                        found.setdefault(f"pictures/{camera}", []).append(value / np.float32(255))
                frame += 1
        if splits[split][-1] != last:
            raise SystemExit(f"{split}: the last record is another one when it is asked for alone")
    np.savez(out, report=json.dumps({"splits": splits}), **{name: np.stack(v) for name, v in found.items()})


main(Path(sys.argv[1]), Path(sys.argv[2]), sorted(int(word) for word in sys.argv[3:]))
