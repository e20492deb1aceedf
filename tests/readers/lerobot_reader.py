"""Load a dataset with the real lerobot (0.4.4 or 0.3.3): lerobot_reader.py DATASET OUT.npz FRAME...

Writes every number of every frame, by feature, and pictures and task of the frames that are named.
"""

import json
import sys
from pathlib import Path

import av
import lerobot.datasets.lerobot_dataset as lerobot_dataset
import numpy as np
import torch
from lerobot.datasets.utils import dataset_to_policy_features


def decode(
    path: Path, timestamps: list[float], tolerance_s: float, backend: str | None = None
) -> torch.Tensor:
    """Frames (N, 3, H, W) in 0..1 at the timestamps; lerobot's own decoder needs torchcodec."""
    found = []
    with av.open(str(path)) as container:
        video = container.streams.video[0]
        for timestamp in timestamps:
            container.seek(max(int(timestamp / video.time_base) - 1, 0), stream=video)
            frames = (
                (abs(float(frame.pts * video.time_base) - timestamp), frame)
                for frame in container.decode(video)
            )
            near = next((frame for distance, frame in frames if distance < tolerance_s), None)
            if near is None:
                raise SystemExit(f"{path}: no frame within {tolerance_s} s of {timestamp}")
            found.append(torch.from_numpy(near.to_ndarray(format="rgb24")))
    return torch.stack(found).permute(0, 3, 1, 2).float() / 255


def main(root: Path, out: Path, chosen: list[int]) -> None:
    lerobot_dataset.decode_video_frames = decode
    dataset = lerobot_dataset.LeRobotDataset("local/check", root=root)
    pictures = [name for name in dataset.features if name.startswith("observation.images.")]
    found = {}
    for name in dataset.hf_dataset.column_names:
        if name not in pictures:
            found[f"numbers/{name}"] = np.array(dataset.hf_dataset.with_format(None)[name][:])
    items = [dataset[index] for index in chosen]
    for name in pictures:
        stack = torch.stack([item[name] for item in items]).permute(0, 2, 3, 1)
        found[f"pictures/{name.removeprefix('observation.images.')}"] = stack.numpy()
    window = lerobot_dataset.LeRobotDataset(
        "local/check", root=root, delta_timestamps={"action": [i / dataset.fps for i in range(4)]}
    )
    policy = dataset_to_policy_features(dataset.features)
    report = {
        "episodes": dataset.num_episodes,
        "frames": dataset.num_frames,
        "policy_features": {name: feature.type.value for name, feature in policy.items()},
        "statistics": {
            name: {kind: np.asarray(numbers).tolist() for kind, numbers in kinds.items()}
            for name, kinds in dataset.meta.stats.items()
        },
        "tasks": [item["task"] for item in items],
        "indices": [int(item["index"]) for item in items],
        "window": np.asarray(window[0]["action"]).tolist(),
    }
    np.savez(out, report=json.dumps(report), **found)


main(Path(sys.argv[1]), Path(sys.argv[2]), [int(word) for word in sys.argv[3:]])
