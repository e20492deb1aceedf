"""What is done to a run that makes episodes costs nothing that was told to be done, and changes no byte.

A few of the points of `python -m benchmarks faults`, which prints the figures of all.
"""

import importlib.util
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Executor
from pathlib import Path

import pytest

from fault_run import start_workers
from fault_trees import AFTER, read_tree
from fault_workers import ray_deaths, ray_store, worker_deaths
from faults import disk_full, kills, prepare

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Executor, Path]]:
    """Processes, and a folder with an undisturbed run."""
    scratch = tmp_path_factory.mktemp("faults")
    with start_workers() as pool:
        prepare(pool, scratch)
        yield pool, scratch


def test_killed_runs_end_in_the_same_bytes(runs):
    assert kills(*runs, points=6) == {"points": 6, "lost": 0, "partial": 0, "trees_equal": 6}


def test_a_full_disk_is_named_and_costs_nothing(runs):
    figures = disk_full(*runs, every=31)
    writes = figures["writes"]
    assert writes > 5
    assert figures == {"writes": writes, "typed": writes, "lost": 0, "partial": 0, "trees_equal": writes}


def test_neither_folder_locale_nor_time_zone_change_a_byte_and_none_is_told(runs, monkeypatch):
    _, scratch = runs
    for name, value in (("LC_ALL", "de_DE.UTF-8"), ("TZ", "Asia/Tokyo")):
        monkeypatch.setenv(name, value)
    out = scratch / "mein Ördner 日本"
    command = "import sys; from pathlib import Path; from fault_run import make_here; "
    command += f"make_here(Path({str(out)!r}), {AFTER!r}, 0)"
    subprocess.run(
        [sys.executable, "-c", command], cwd=Path(__file__).parents[1] / "helpers", check=True, timeout=300
    )
    made = read_tree(out)
    assert made == read_tree(scratch / AFTER)
    texts = {name: data.decode() for name, data in made.items() if name.endswith((".json", ".usda"))}
    assert len(texts) > 10
    private = "|".join(map(re.escape, (str(scratch), str(Path.home()), socket.gethostname())))
    assert not [name for name, text in texts.items() if re.search(rf"(?<!\w)({private})(?!\w)", text)]


def test_every_requested_episode_is_accounted_for_when_workers_die(tmp_path):
    figures = worker_deaths(tmp_path, deaths=2, requested=8)
    assert [figures[name] for name in ("deaths", "accounted", "left", "partial")] == [2, 8, 0, 0]


def test_a_killed_ray_worker_and_node_change_nothing(tmp_path):
    if importlib.util.find_spec("ray") is None:
        pytest.skip("ray is not installed")
    assert ray_deaths(tmp_path) == {"killed": ["worker", "node"], "episodes": 6, "tree_equal": True}


def test_a_store_replaces_shared_folders_and_may_vanish(tmp_path):
    for package in ("ray", "fsspec"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed")
    assert ray_store(tmp_path) == {"typed": True, "episodes": 6, "tree_equal": True}
