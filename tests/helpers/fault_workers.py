"""Deaths of workers, on this machine and on a Ray cluster; the run continues."""

import multiprocessing
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import count
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np

from aomgen.core.progress import silent
from aomgen.episodes import stage as stage_module
from aomgen.episodes.ledger import read_accounts
from aomgen.episodes.stage import run as generate
from aomgen.errors import StorageError, WorkerError
from aomgen.executors import Done
from aomgen.io.artifact import read_json
from aomgen.io.atomic import STAGING_PREFIX, write_json
from aomgen.io.episode_folder import list_committed, read_episode
from fault_run import INPUTS, PARAMS, in_child
from fault_trees import read_tree
from toy_run import FOLDERS, ToyResults, elsewhere, toy_results, toy_run

ASSETS, WORKERS = 2, 2
# Duration of a unit, [s]; a worker is killed at a random time within it.
UNIT_S: Final = 1.0
# Time after which a run counts as hanging, [s]; 200 episodes take two minutes.
HANGS_S: Final = 1200.0
# Resources of each of the two nodes of a Ray cluster: one processor, and the least shared memory that Ray accepts, [bytes].
NODE: Final = {"num_cpus": 1, "object_store_memory": 80 << 20}
# Episodes of an asset in a run on Ray, and the numbers of units after which a worker and a node are killed.
RAY_POSES, RAY_FAULTS_AFTER = 3, (1, 3)
# Time after which a cluster without a busy worker is considered idle, [s].
IDLE_S: Final = 20.0


def worker_deaths(scratch: Path, deaths: int = 50, requested: int = 200) -> dict[str, int]:
    """Kill the older one of two workers repeatedly during a run.

    Args:
        scratch: A folder.
        deaths: Number of kills.
        requested: Number of episodes of both assets together; at least as many units are made.

    Returns:
        `accounted` are those of the requested episodes that are committed and readable, or of which the ledger says that
        all attempts have failed; `partial` are files that are half-written; `given_up` are attempts whose worker died every time.
    """
    results = toy_run(scratch / INPUTS, params=PARAMS, poses=requested // ASSETS, assets=ASSETS)
    out, file = scratch / "run", scratch / "deaths.json"
    code = in_child(
        partial(_die_often, elsewhere(results, out, workers=WORKERS), deaths, requested, file), HANGS_S
    )
    if code:
        raise WorkerError(out, f"ended with code {code}", "see its traceback")
    folder = out / FOLDERS["episodes"]
    accounts = read_accounts(folder)
    readable = sum(len(read_episode(path).episode) > 0 for path in list_committed(folder))
    rejected = sum(account.rejected for account in accounts)
    return {
        "deaths": read_json(file)["deaths"],
        "requested": requested,
        "committed": readable,
        "rejected": rejected,
        "left": sum(account.left for account in accounts),
        "accounted": readable + rejected,
        "partial": sum(STAGING_PREFIX in name for name in read_tree(folder, staging=True)),
        "given_up": sum(account.reasons.get("worker_died", 0) for account in accounts),
    }


def _die_often(results: ToyResults, deaths: int, requested: int, file: Path) -> None:
    """Make the episodes; kill the oldest worker shortly after every few units."""
    rng, units, killed = np.random.default_rng(0), 0, list[threading.Timer]()

    def heard(done: Done) -> None:
        nonlocal units
        units += 1
        waiting = killed and killed[-1].is_alive()
        if units % (requested // deaths) == 0 and len(killed) < deaths and not waiting:
            oldest = min(multiprocessing.active_children(), key=_number)
            killed.append(threading.Timer(float(rng.uniform(0, UNIT_S)), oldest.kill))
            killed[-1].start()

    _generate(results, heard)
    write_json(file, {"deaths": len(killed)})


def _number(process: BaseProcess) -> int:
    """Return the number of a process among the children of its parent, by its name."""
    return int(re.split("[-:]", process.name)[-1])


def ray_deaths(scratch: Path) -> dict[str, Any]:
    """Kill a worker process, and then a node, of a Ray cluster in the middle of a run; compare with an undisturbed run."""
    results = toy_run(scratch / INPUTS, params=PARAMS, poses=RAY_POSES, assets=ASSETS)
    code = in_child(partial(_on_ray, results, scratch), HANGS_S, "spawn")
    if code:
        raise WorkerError(scratch, f"ended with code {code}", "see its traceback")
    disturbed = scratch / "disturbed"
    return {
        "killed": ["worker", "node"],
        "episodes": len(list_committed(disturbed / FOLDERS["episodes"])),
        "tree_equal": read_tree(disturbed, staging=True) == read_tree(scratch / "undisturbed"),
    }


def _on_ray(results: ToyResults, scratch: Path) -> None:
    """Make an undisturbed run in processes, then one on a cluster.

    Raises:
        WorkerError: The run ended before both faults had happened.
    """
    _generate(elsewhere(results, scratch / "undisturbed", workers=WORKERS), lambda done: None)
    with _cluster() as cluster:
        node = cluster.add_node(**NODE)
        faults = {
            RAY_FAULTS_AFTER[0]: partial(_kill_ray_worker, cluster),
            RAY_FAULTS_AFTER[1]: partial(cluster.remove_node, node, allow_graceful=False),
        }
        # The run continues during a fault: both workers may be idle at this moment, until it submits the next units.
        with ThreadPoolExecutor(1) as thread:
            heard, happened = count(1), list[Future[None]]()

            def hear(_: Done) -> None:
                if fault := faults.get(next(heard)):
                    happened.append(thread.submit(fault))

            _generate(elsewhere(results, scratch / "disturbed", ray=cluster.address), hear)
        for fault in happened:
            fault.result()
    if len(happened) < len(faults):
        raise WorkerError("ray", "was done before both faults")


def ray_store(scratch: Path) -> dict[str, Any]:
    """Generate episodes on a Ray cluster whose workers have only a store, which is deleted in the middle of the run.

    Returns:
        `typed` is whether the run ended with a `StorageError`, `episodes` and `tree_equal` are those of the continued run.
    """
    for name in ("undisturbed", "disturbed"):
        toy_run(scratch / name, params=PARAMS, poses=RAY_POSES, assets=ASSETS)
    code = in_child(partial(_on_ray_with_store, scratch), HANGS_S, "spawn")
    if code:
        raise WorkerError(scratch, f"ended with code {code}", "see its traceback")
    disturbed = scratch / "disturbed"
    return {
        **read_json(scratch / "errors.json"),
        "episodes": len(list_committed(disturbed / FOLDERS["episodes"])),
        "tree_equal": read_tree(disturbed, staging=True) == read_tree(scratch / "undisturbed"),
    }


def _on_ray_with_store(scratch: Path) -> None:
    """Make an undisturbed run in processes, then one on a cluster, from which the inputs of the run are hidden."""
    plain, run = (
        toy_results(scratch / name, params=PARAMS, poses=RAY_POSES, assets=ASSETS)
        for name in ("undisturbed", "disturbed")
    )
    generate(replace(plain, workers=WORKERS), plain.folders["episodes"], silent)
    store, fitted = scratch / "store", run.folders["replacement"]
    opened, heard, typed = stage_module.open_executor, list[Done](), False

    def open_hidden(*arguments: Any) -> Any:
        fitted.rename(scratch / "hidden")
        return opened(*arguments)

    def vanish(done: Done) -> None:
        heard.append(done)
        if len(heard) == RAY_FAULTS_AFTER[0]:
            # Unlike a deletion, a renaming cannot meet a file that a worker is about to rename.
            store.rename(scratch / "vanished")

    with _cluster() as cluster, patch.object(stage_module, "open_executor", open_hidden):
        cluster.add_node(**NODE)
        results = replace(run, ray=cluster.address, store=str(store))
        try:
            generate(results, run.folders["episodes"], silent, vanish)
        except StorageError:
            typed = True
        (scratch / "hidden").rename(fitted)
        generate(results, run.folders["episodes"], silent, heard.append)
    (scratch / "hidden").rename(fitted)
    write_json(scratch / "errors.json", {"typed": typed})


@contextmanager
def _cluster() -> Iterator[Any]:
    """Start a cluster with its first node, whose workers can import the modules of this folder."""
    from ray.cluster_utils import Cluster

    os.environ["PYTHONPATH"] = str(Path(__file__).parent)
    cluster = Cluster(initialize_head=True, head_node_args={**NODE, "include_dashboard": False})
    try:
        yield cluster
    finally:
        cluster.shutdown()


def _kill_ray_worker(cluster: Any) -> None:
    """Kill a busy process; wait for one, because all processes are idle between two units.

    Raises:
        WorkerError: No worker was busy for `IDLE_S`.
    """
    end = time.monotonic() + IDLE_S
    while time.monotonic() < end:
        for worker in _at_work(cluster):
            with suppress(ProcessLookupError):  # it has ended
                os.kill(worker, signal.SIGKILL)
                return
        time.sleep(0.01)
    raise WorkerError("ray", "has no worker at work")


def _at_work(cluster: Any) -> Iterator[int]:
    """List the processes of a cluster that are working on a unit."""
    for node in cluster.list_all_nodes():
        (raylet,) = node.all_processes["raylet"]
        for child in _children(raylet.process.pid):
            with suppress(FileNotFoundError, ProcessLookupError):  # it has ended
                if b"_do_on_ray" in Path(f"/proc/{child}/cmdline").read_bytes():
                    yield child


def _children(process: int) -> list[int]:
    tasks = Path(f"/proc/{process}/task").iterdir()
    return [int(child) for task in tasks for child in (task / "children").read_text().split()]


def _generate(results: ToyResults, heard: Callable[[Done], None]) -> None:
    folder = results.folders["episodes"]
    folder.mkdir(parents=True)
    generate(results, folder, silent, heard)
