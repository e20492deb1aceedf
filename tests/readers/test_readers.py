"""The libraries that people train with read our datasets: equal numbers, pictures, tasks, splits and statistics.

Every library lives in an environment of its own, see environments.sh; `make datasets-test` creates them. Without
EPISODES (a folder of committed episodes) small ones are made.
"""

import json
import os
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aomgen.datasets.features import read_images
from aomgen.datasets.formats import FORMATS, export_dataset
from aomgen.datasets.rlds import STATISTICS_FILE, VERSION
from aomgen.datasets.robomimic import scale_actions
from aomgen.datasets.selection import Selection
from aomgen.io.artifact import read_json
from aomgen.io.episode_folder import list_committed
from aomgen.splatting.metrics import psnr
from small_episodes import commit

PROJECT = Path(__file__).parents[2]
# Environment and script that read a format.
READERS = {
    "lerobot-v3": (".venv-policy", "lerobot_reader.py"),
    "lerobot-v2.1": (".venv-lerobot-v21", "lerobot_reader.py"),
    "rlds": (".venv-tfds", "tfds_reader.py"),
    "rlds-array-record": (".venv-tfds", "array_record_reader.py"),
    "hdf5": (".venv-robomimic", "robomimic_reader.py"),
}
pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Read:
    """What a library found in a dataset that was made of the selected episodes."""

    dataset: Path
    selection: Selection
    report: Mapping[str, Any]
    numbers: Mapping[str, np.ndarray]

    def wanted(self, kind: str) -> dict[str, np.ndarray]:
        """Numbers of all frames by feature, as the episodes have them."""
        tables = [
            FORMATS[kind].columns(item.episode, self.selection.choices.actions)
            for item in self.selection.episodes
        ]
        return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> list[Path]:
    if "EPISODES" in os.environ:
        return list_committed(Path(os.environ["EPISODES"]))
    root = tmp_path_factory.mktemp("episodes")
    return [commit(root, index, frames) for index, frames in enumerate((12, 9, 15, 8))]


def chosen_frames(selection: Selection) -> dict[int, tuple[int, int]]:
    """Episode and frame by number in the dataset: first, middle and last of first, middle and last episode."""
    lengths = [len(item.episode) for item in selection.episodes]
    starts = np.cumsum([0, *lengths])
    episodes = sorted({0, len(lengths) // 2, len(lengths) - 1})
    pairs = [(e, frame) for e in episodes for frame in (0, lengths[e] // 2, lengths[e] - 1)]
    return {int(starts[e]) + frame: (e, frame) for e, frame in pairs}


def read(folders: list[Path], folder: Path, kind: str, **options: Any) -> Read:
    """Export and let the real library read; its pictures are compared here."""
    environment, script = READERS[kind]
    python = PROJECT / environment / "bin" / "python"
    if not python.exists():
        pytest.skip(f"{environment} is missing; make datasets-test creates it")
    dataset, out = folder / "dataset", folder / "found.npz"
    selection = export_dataset(folders, dataset, kind, **options)
    chosen = chosen_frames(selection)
    command = [python, PROJECT / "tests" / "readers" / script, dataset, out, *map(str, chosen)]
    settings = os.environ | {"HF_HOME": str(folder / "cache"), "HF_HUB_OFFLINE": "1"}
    done = subprocess.run(command, env=settings, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with np.load(out) as found:
        report = json.loads(str(found["report"]))
        numbers = {key.removeprefix("numbers/"): found[key] for key in found if key.startswith("numbers/")}
        pictures = {key.removeprefix("pictures/"): found[key] for key in found if key.startswith("pictures/")}
    compare_pictures(pictures, selection, list(chosen.values()), media=options.get("media", ""))
    return Read(dataset, selection, report, numbers)


def compare_pictures(
    pictures: Mapping[str, np.ndarray], selection: Selection, chosen: list[tuple[int, int]], media: str
) -> None:
    assert set(pictures) == set(selection.episodes[0].episode.cameras)
    least = np.inf
    for camera, found in pictures.items():
        assert len(found) == len(chosen)
        for picture, (episode, frame) in zip(found, chosen, strict=True):
            shown = next(islice(read_images(selection.episodes[episode], camera), frame, None))
            least = min(least, psnr(picture, shown / np.float32(255)))
    print(f"least likeness of a picture: {least:.1f} dB")
    assert least >= (100 if media == "image" else 35)


def compare_numbers(found: Mapping[str, np.ndarray], wanted: Mapping[str, np.ndarray]) -> None:
    assert set(wanted) <= set(found)
    differences = {
        name: float(np.abs(np.reshape(found[name], values.shape) - values).max())
        for name, values in wanted.items()
    }
    print(f"largest difference of a number: {max(differences.values()):.1e}")
    shares = {name: differences[name] / max(1, np.abs(values).max()) for name, values in wanted.items()}
    assert max(shares.values()) <= 1e-6, shares


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("lerobot-v3", {}),
        ("lerobot-v3", {"media": "image", "size": "64x48", "actions": "ee_delta", "val": 1}),
        ("lerobot-v2.1", {}),
        ("lerobot-v2.1", {"media": "image", "size": "64x48", "actions": "ee_absolute", "val": 1}),
    ],
)
def test_lerobot(folders, tmp_path, kind, options):
    got = read(folders, tmp_path, kind, **options)
    report, episodes = got.report, got.selection.episodes
    wanted = got.wanted(kind)
    compare_numbers(got.numbers, wanted)
    assert (report["episodes"], report["frames"]) == (len(episodes), got.selection.frames)
    chosen = chosen_frames(got.selection)
    assert report["indices"] == list(chosen)
    assert report["tasks"] == [episodes[episode].episode.instruction for episode, _ in chosen.values()]
    cameras = {f"observation.images.{name}": "VISUAL" for name in episodes[0].episode.cameras}
    assert report["policy_features"] == {"observation.state": "STATE", "action": "ACTION"} | cameras
    np.testing.assert_allclose(report["window"], wanted["action"][:4], atol=1e-6)
    kinds = {"min", "max", "mean", "std", "count"} | ({"q01", "q99"} if kind == "lerobot-v3" else set())
    assert all(kinds <= set(report["statistics"][name]) for name in ("observation.state", "action", *cameras))
    statistics = report["statistics"]["action"]
    actions = wanted["action"].astype(np.float64)
    np.testing.assert_allclose(statistics["mean"], actions.mean(0), atol=1e-6)
    np.testing.assert_allclose(statistics["std"], actions.std(0), atol=1e-6)


@pytest.mark.parametrize("options", [{}, {"actions": "joint", "size": "64x48", "val": 2}])
def test_rlds(folders, tmp_path, options):
    got = read(folders, tmp_path, "rlds", **options)
    wanted = got.wanted("rlds")
    compare_numbers(got.numbers, wanted)
    indices = {name: [item.episode.index for item in items] for name, items in got.selection.splits.items()}
    assert {name: sorted(found) for name, found in got.report["splits"].items()} == indices
    episodes = got.selection.episodes
    chosen = chosen_frames(got.selection).values()
    assert got.report["tasks"] == [episodes[episode].episode.instruction for episode, _ in chosen]
    written = read_json(got.dataset / VERSION / STATISTICS_FILE)[got.dataset.name]
    differences = [
        np.abs(np.subtract(written[feature][name], values)).max()
        for feature, numbers in got.report["statistics"].items()
        for name, values in numbers.items()
    ]
    print(f"largest difference of OpenVLA's statistics: {max(differences):.1e}")
    assert len(differences) == 12
    assert max(differences) <= 1e-6
    ends = np.cumsum([len(item.episode) for item in episodes]) - 1
    assert np.flatnonzero(got.numbers["is_last"]).tolist() == ends.tolist()
    assert np.flatnonzero(got.numbers["reward"]).tolist() == ends.tolist()


def test_array_record(folders, tmp_path):
    got = read(folders, tmp_path, "rlds-array-record", size="64x48")
    compare_numbers(got.numbers, got.wanted("rlds-array-record"))
    indices = {name: [item.episode.index for item in items] for name, items in got.selection.splits.items()}
    assert got.report["splits"] == indices


@pytest.mark.parametrize("options", [{}, {"actions": "ee_delta", "size": "64x48", "val": 2}])
def test_robomimic(folders, tmp_path, options):
    got = read(folders, tmp_path, "hdf5", **options)
    wanted = got.wanted("hdf5")
    scaled = got.numbers["actions"]
    limits = np.array(got.report["limits"])
    compare_numbers(
        {"action": scaled, "observation.state": got.numbers["observation.state"]},
        {
            "action": scale_actions(wanted["action"], *limits),
            "observation.state": wanted["observation.state"],
        },
    )
    assert np.abs(scaled).max() <= 1
    train, val = (sum(len(item.episode) for item in items) for items in got.selection.splits.values())
    assert got.report["lengths"] == {"train": train, "valid": val}
    assert got.report["wrong_next"] == 0
    ends = np.cumsum([len(item.episode) for item in got.selection.episodes]) - 1
    assert np.flatnonzero(got.numbers["dones"]).tolist() == ends.tolist()
