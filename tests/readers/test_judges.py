"""Programs of others judge what we write: `lerobot-doctor` the dataset, PlayCanvas's `splat-transform` files of Gaussians.

They live in `.venv-judges`, see environments.sh; `make datasets-test` creates it. The doctor looks at the episodes in EPISODES.
"""

import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aomgen.core.gaussians import Gaussians, gaussians_of
from aomgen.datasets.formats import export_dataset
from aomgen.io.episode_folder import list_committed
from aomgen.io.gaussian_files import read_gaussians, write_gaussians

JUDGES = Path(__file__).parents[2] / ".venv-judges"
# Warnings of the doctor that do no harm, and why.
HARMLESS = {
    r"action\[6\]: [\d.]+% of values at minimum": "the gripper is open on most of the way",
    r"action\[6\]: stuck/static in": "the gripper only opens and closes once",
    r"annotation\.object_pose.*(zero variance|constant dimension)": "objects stand upright on one table",
    r"annotation\.keypoints_px.*(zero variance|constant dimension)": "a fixed camera sees some points in every frame",
    r"annotation\.keypoints_px\.\w+\[(2|5|8|11|14)\]: \d+ extreme outlier": "a point is rarely hidden",
    r"episodes shorter than chunk_size=100": "a demonstration lasts some ten seconds at 10 Hz",
}
pytestmark = pytest.mark.slow


def judge(program: str, *arguments: object, folder: Path) -> str:
    """Run a program of the judges; what it prints."""
    path = JUDGES / program
    if not path.exists():
        pytest.skip(f"{path} is missing; make datasets-test creates it")
    settings = os.environ | {"HF_HUB_OFFLINE": "1"}
    command = [str(path), *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, env=settings, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def splat_transform(*arguments: object, folder: Path) -> str:
    return judge("node_modules/.bin/splat-transform", *arguments, folder=folder)


def count_of(path: Path) -> int:
    """Number of Gaussians that splat-transform finds."""
    printed = splat_transform("-q", path, "--info", "json", "null", folder=path.parent)
    return int(json.loads(printed[printed.index("{") :])["numGaussians"])


@pytest.mark.parametrize("media", ["video", "image"])
def test_the_doctor_finds_nothing_new(tmp_path: Path, media: str) -> None:
    if "EPISODES" not in os.environ:
        pytest.skip("EPISODES is not set: made episodes are not like demonstrations")
    episodes = list_committed(Path(os.environ["EPISODES"]))
    export_dataset(episodes, tmp_path / "dataset", "lerobot-v3", media=media)
    printed = judge("bin/lerobot-doctor", "check", "dataset", "--json", folder=tmp_path)
    report: dict[str, Any] = json.loads(printed[printed.index("{") :])
    assert report["total_episodes"] == len(episodes)
    assert report["summary"]["FAIL"] == 0
    found = [item for check in report["checks"] for item in check["messages"] if item["severity"] != "PASS"]
    new = [item for item in found if not any(re.search(known, item["message"]) for known in HARMLESS)]
    assert not new


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    rng, count = np.random.default_rng(4), 500
    quats = rng.normal(size=(count, 4))
    return gaussians_of(
        means=rng.normal(size=(count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(rng.normal(-4, 0.5, (count, 3))),
        opacities=rng.uniform(0.05, 0.95, count),
        sh=rng.uniform(-0.5, 0.5, (count, 16, 3)),
    )


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".spz"])
def test_splat_transform_reads_ours(gaussians: Gaussians, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"ours{suffix}"
    write_gaussians(path, gaussians)
    assert count_of(path) == len(gaussians)
    splat_transform("-q", "-w", path.name, "theirs.ply", folder=tmp_path)
    compare(read_gaussians(tmp_path / "theirs.ply"), read_gaussians(path))


def test_we_read_theirs(gaussians: Gaussians, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "ours.ply", gaussians)
    splat_transform("-q", "-w", "ours.ply", "--spz-version", 3, "theirs.spz", folder=tmp_path)
    write_gaussians(tmp_path / "ours.spz", gaussians)
    found = read_gaussians(tmp_path / "theirs.spz")
    np.testing.assert_allclose(found.means, gaussians.means, atol=2**-12)
    # One step of the logarithm, where the two round a half to different sides.
    np.testing.assert_allclose(found.scales, read_gaussians(tmp_path / "ours.spz").scales, rtol=0.07)


def test_glb_is_as_theirs(gaussians: Gaussians, tmp_path: Path) -> None:
    """splat-transform writes .glb and does not read it: its file of the same Gaussians holds what ours does.

    It takes the coordinates of a .ply as x right, y down, z forward, and turns them for glTF.
    """
    write_gaussians(tmp_path / "ours.ply", gaussians)
    splat_transform("-q", "-w", "ours.ply", "theirs.glb", folder=tmp_path)
    write_gaussians(tmp_path / "ours.glb", gaussians.transform(np.diag([-1.0, -1.0, 1.0, 1.0])))
    found, wanted = (read_gaussians(tmp_path / f"{who}.glb") for who in ("theirs", "ours"))
    compare(found, wanted)
    assert attributes(tmp_path / "theirs.glb") == attributes(tmp_path / "ours.glb")


def attributes(path: Path) -> dict[str, Any]:
    """The primitive of a .glb, with its accessors' types instead of their numbers."""
    data = path.read_bytes()
    described = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    (primitive,) = described["meshes"][0]["primitives"]
    kinds = ("type", "componentType", "count", "normalized")
    shapes = {
        name: {kind: described["accessors"][number].get(kind) for kind in kinds}
        for name, number in primitive["attributes"].items()
    }
    return {"attributes": shapes, "extensions": primitive["extensions"], "mode": primitive["mode"]}


def compare(found: Gaussians, wanted: Gaussians) -> None:
    assert len(found) == len(wanted)
    for name in ("means", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=2e-5, err_msg=name)
    turns = np.abs((found.quats.astype(np.float64) * wanted.quats).sum(1))
    # Bytes of a .splat's rotations may be divided by 127 or 128.
    assert turns.min() > 1 - 1e-4
