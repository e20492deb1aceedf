"""Load a dataset with the real lerobot; run with .venv-policy/bin/python, not with ours.

Prints one JSON line: episodes, frames, and the mean grey of the first frame of the first, the
last of the middle and the last of the last episode, for each camera in name order.
"""

import json
import sys
from pathlib import Path

import av
import lerobot.datasets.lerobot_dataset as lerobot_dataset
import torch
from lerobot.datasets.utils import dataset_to_policy_features


def decode(
    path: Path, timestamps: list[float], tolerance_s: float, backend: str | None = None
) -> torch.Tensor:
    """Frames (N, 3, H, W) in 0..1 at the timestamps; lerobot's own decoder needs torchcodec."""
    frames, times = [], []
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            times.append(float(frame.pts * frame.time_base))
            frames.append(torch.from_numpy(frame.to_ndarray(format="rgb24")))
    distances = (torch.tensor(timestamps)[:, None] - torch.tensor(times)[None]).abs()
    nearest = distances.argmin(1)
    if not distances.min(1).values.max() < tolerance_s:
        raise SystemExit(f"{path}: no frame within {tolerance_s} s of {timestamps}")
    return torch.stack([frames[i] for i in nearest]).permute(0, 3, 1, 2).float() / 255


def main(root: Path) -> None:
    """Load everything once and print what was found."""
    lerobot_dataset.decode_video_frames = decode
    dataset = lerobot_dataset.LeRobotDataset("local/check", root=root)
    cameras = sorted(key for key in dataset.features if key.startswith("observation.images."))
    rows = dataset.meta.episodes
    starts = [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows]
    chosen = [starts[0][0], starts[len(starts) // 2][1] - 1, starts[-1][1] - 1]
    items = [dataset[index] for index in chosen]
    for item, index in zip(items, chosen, strict=True):
        if int(item["index"]) != index or not isinstance(item["task"], str):
            raise SystemExit(f"frame {index} came back as {item['index']} with task {item['task']!r}")
    window = lerobot_dataset.LeRobotDataset(
        "local/check", root=root, delta_timestamps={"action": [i / dataset.fps for i in range(4)]}
    )
    if tuple(window[0]["action"].shape) != (4, dataset.features["action"]["shape"][0]):
        raise SystemExit(f"a window of actions has shape {tuple(window[0]['action'].shape)}")
    for name in ("q01", "q99", "mean", "std"):
        if name not in dataset.meta.stats["observation.state"]:
            raise SystemExit(f"statistics lack {name}")
    features = dataset_to_policy_features(dataset.features)
    if set(features) != {"observation.state", "action", *cameras}:
        raise SystemExit(f"a policy would be given {sorted(features)}")
    report = {
        "episodes": dataset.num_episodes,
        "frames": dataset.num_frames,
        "policy_features": {name: feature.type.value for name, feature in features.items()},
        "grey": [[float(item[camera].mean()) for camera in cameras] for item in items],
    }
    sys.stdout.write(json.dumps(report) + "\n")


main(Path(sys.argv[1]))
