"""Faults of runs that make episodes: kills, a full disk, dead workers. `python -m benchmarks faults` counts them."""

import errno
import os
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

from aomgen.errors import StorageError, WorkerError
from aomgen.ray_cluster import require_cluster
from fault_run import INPUTS, PARAMS, RUN_S, at_operation, in_child, make_here, open_here, start_workers
from fault_trees import AFTER, BEFORE, Left, begin_over, look, summary
from fault_workers import ray_deaths, ray_store, worker_deaths
from toy_run import toy_run

# Kinds of kills, in turn: at a time, at a file operation, and less often at a time with busy worker processes.
WAYS: Final = ("time", "operation") * 4 + ("time", "workers")
WORKERS: Final = 2
# Factor on the time of the next kill if a run ended before it was killed.
EARLIER: Final = 0.8


def run_faults(scratch: Path, points: int, notify: Callable[[str], None]) -> dict[str, Any]:
    """Measure all figures; see `docs/episodes.md`.

    Args:
        scratch: An empty folder.
        points: Number of kills.
        notify: Receives the figures of each part.

    Raises:
        BackendError: Ray is not installed.
        WorkerError: A run has an unexpected exit code, or hangs.
    """
    require_cluster("local")
    figures: dict[str, Any] = {}
    with start_workers() as pool:
        prepare(pool, scratch)
        for name, part in (("kills", partial(kills, points=points)), ("disk_full", disk_full)):
            figures[name] = part(pool, scratch)
            notify(f"{name}: {figures[name]}")
    for name, alone in (("worker_deaths", worker_deaths), ("ray", ray_deaths), ("store", ray_store)):
        figures[name] = alone(scratch / name)
        notify(f"{name}: {figures[name]}")
    return figures


def prepare(pool: Executor, scratch: Path) -> None:
    """Write the inputs of all runs, a finished run of other inputs, and the undisturbed run."""
    toy_run(scratch / INPUTS, params=PARAMS)
    pool.submit(_undisturbed, scratch, BEFORE).result()
    begin_over(scratch, scratch / AFTER)
    pool.submit(_undisturbed, scratch, AFTER).result()


def kills(pool: Executor, scratch: Path, points: int) -> dict[str, int]:
    """Kill runs at times spread over their duration, continue them and compare."""
    ways = [WAYS[number % len(WAYS)] for number in range(points)]
    shares = [(ways[:number].count(way) + 0.5) / ways.count(way) for number, way in enumerate(ways)]
    left = pool.map(partial(_kill, scratch), range(points), ways, shares)
    return {"points": points, **summary(left)}


def disk_full(pool: Executor, scratch: Path, every: int = 1) -> dict[str, int]:
    """Fill the disk from each write of a run on, in turn; then free it and continue the run.

    Args:
        pool: Pool of processes.
        scratch: See `prepare`.
        every: Only every n-th write is tested.
    """
    operations = pool.submit(_operations, scratch).result()
    left = list(pool.map(partial(_fill_disk, scratch), range(1, operations + 1, every)))
    typed = sum(item.code == StorageError.exit_code for item in left)
    return {"writes": len(left), "typed": typed, **summary(left)}


def _undisturbed(scratch: Path, name: str) -> None:
    open_here(scratch)
    code = in_child(partial(make_here, scratch / name, name, 0))
    if code:
        raise WorkerError(scratch / name, f"ended with code {code}, undisturbed", "see its traceback")


@cache
def _seconds(scratch: Path, workers: int) -> float:
    """Measure the duration of an undisturbed run under the load of the tests."""
    out = scratch / f"timed-{os.getpid()}"
    open_here(scratch)
    begin_over(scratch, out)
    start = time.monotonic()
    in_child(partial(make_here, out, AFTER, workers))
    return time.monotonic() - start


@cache
def _operations(scratch: Path) -> int:
    """Count the file operations of an undisturbed run."""
    out = scratch / f"counted-{os.getpid()}"
    counted = out.with_suffix(".operations")
    open_here(scratch)
    begin_over(scratch, out)
    in_child(partial(_count, out, counted))
    return int(counted.read_text())


def _count(out: Path, counted: Path) -> None:
    begun = at_operation(sys.maxsize, _refuse)
    make_here(out, AFTER, 0)
    counted.write_text(str(begun()))


def _kill(scratch: Path, number: int, way: str, share: float) -> Left:
    """Kill a run after a share of its duration, and examine it."""
    out, workers, code = scratch / f"kill-{number}", WORKERS if way == "workers" else 0, 0
    work: Callable[[], None] = partial(make_here, out, AFTER, workers)
    if way == "operation":
        limit_s, work = RUN_S, partial(_at, 1 + int(share * _operations(scratch)), _die, work)
    else:
        limit_s = share * _seconds(scratch, workers)
    open_here(scratch)
    while not code:
        begin_over(scratch, out)
        code = in_child(work, limit_s)
        limit_s *= EARLIER
    if code != -signal.SIGKILL:
        raise WorkerError(out, f"ended with code {code} before it was killed", "see its traceback")
    return look(scratch, out, code)


def _fill_disk(scratch: Path, number: int) -> Left:
    """Fill the disk from a write on, and examine the run."""
    out = scratch / f"full-{number}"
    open_here(scratch)
    begin_over(scratch, out)
    return look(scratch, out, in_child(partial(_at, number, _refuse, partial(make_here, out, AFTER, 0))))


def _at(number: int, fault: Callable[[str, Any], None], work: Callable[[], None]) -> None:
    at_operation(number, fault)
    work()


def _die(name: str, argument: Any) -> None:
    os.killpg(0, signal.SIGKILL)


def _refuse(name: str, argument: Any) -> None:
    """Fail as a full disk does, on which half of a file was written before it is synced."""
    if name == "fsync":
        with suppress(OSError):  # a folder, or a file opened for reading
            os.ftruncate(argument, os.fstat(argument).st_size // 2)
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
