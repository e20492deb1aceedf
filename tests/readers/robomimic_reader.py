"""Load an HDF5 dataset with robomimic's SequenceDataset: robomimic_reader.py DATASET OUT.npz FRAME..."""

import json
import sys
from pathlib import Path

import h5py
import numpy as np
import robomimic.utils.obs_utils as obs_utils
from robomimic.utils.dataset import SequenceDataset


def main(root: Path, out: Path, chosen: list[int]) -> None:
    path = root / "demonstrations.hdf5"
    with h5py.File(path) as file:
        keys = list(file["data/demo_0/obs"])
        limits = [file["data"].attrs[f"action_{end}"].tolist() for end in ("lower", "upper")]
    images = [key for key in keys if key.endswith("_image")]
    modalities = {"obs": {"low_dim": ["state"], "rgb": images}}
    obs_utils.initialize_obs_utils_with_obs_specs([modalities])
    numbers, pictures, lengths, start, wrong_next = {}, {}, {}, 0, 0
    for mask in ("train", "valid"):
        dataset = SequenceDataset(
            str(path),
            obs_keys=keys,
            dataset_keys=("actions", "rewards", "dones", "states"),
            hdf5_cache_mode=None,
            filter_by_attribute=mask,
        )
        lengths[mask] = len(dataset)
        before = None
        for number in range(len(dataset)):
            item = dataset[number]
            for key in ("actions", "rewards", "dones", "states"):
                numbers.setdefault(key, []).append(item[key][0])
            numbers.setdefault("observation.state", []).append(item["obs"]["state"][0])
            if before is not None and not before["dones"][0]:
                wrong_next += sum(
                    not np.array_equal(before["next_obs"][key], item["obs"][key]) for key in keys
                )
            before = item
            if start + number in chosen:
                for key in images:
                    pictures.setdefault(key.removesuffix("_image"), []).append(item["obs"][key][0])
        start += len(dataset)
    report = {"lengths": lengths, "limits": limits, "wrong_next": wrong_next}
    found = {f"numbers/{name}": np.stack(values) for name, values in numbers.items()}
    found |= {
        f"pictures/{name}": np.stack(values).astype(np.float32) / 255 for name, values in pictures.items()
    }
    np.savez(out, report=json.dumps(report), **found)


main(Path(sys.argv[1]), Path(sys.argv[2]), sorted(int(word) for word in sys.argv[3:]))
