"""Draws of `python -m benchmarks replay` on two processes, until there are enough attempts."""

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from functools import partial
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

from aomgen.core.motion import Direction
from benchmarks.recovered import Recovered, recover
from benchmarks.replay import BEYOND, PAPER, Sweep, measure, summary, worst_ik

CATEGORIES: Final = ("microwave", "toolbox", "laptop", "drawer", "cabinet")
# Number of processes, each on one thread: the reference machine has two cores.
WORKERS: Final = 2
# Largest number of draws per attempt of a sweep; attempts beyond the paper's
# ranges for each sweep, as a share.
MAX_DRAWS, BEYOND_SHARE = 20, 0.1
# Key of the metrics of demonstrations that close their object, and the folder in which they are kept.
CLOSING: Final = "closing"
Notify = Callable[[str], None]


def run_replay_bench(
    folder: Path,
    attempts: int,
    seed: int,
    notify: Notify,
    categories: tuple[str, ...] = CATEGORIES,
    others: tuple[Sweep, ...] = BEYOND,
) -> dict[str, Any]:
    """Compute metrics by category, then `ik` over all, of sweeps `beyond`, and by category of `closing`.

    Args:
        folder: Folder of demonstrations and draws; a killed benchmark continues from it.
        attempts: Requested number of draws that pass tier A, in each category.
        seed: Seed of the first motion world, and of all draws.
        notify: Receives every draw.
        categories: Categories that are opened, and closed.
        others: Sweeps beyond the paper's ranges.
    """
    few = max(1, round(BEYOND_SHARE * attempts))
    with start_workers() as pool:

        def recovered(place: Path, direction: Direction) -> dict[str, Recovered]:
            jobs = {name: pool.submit(recover, name, seed, place / name, direction) for name in categories}
            found = {name: job.result() for name, job in jobs.items()}
            for name, item in found.items():
                notify(
                    f"{direction} {name}: {item.world}, {item.fitted.asset.name}; refused {list(item.refused)}"
                )
            return found

        def rows(place: Path, category: str, sweep: Sweep, wanted: int) -> list[dict[str, Any]]:
            return list(_drawn(pool, partial(measure, place, category, sweep, seed), wanted, notify))

        found = recovered(folder, "opening")
        paper = {name: rows(folder, name, PAPER, attempts) for name in categories}
        beyond = {
            sweep.name: {name: summary(rows(folder, name, sweep, few)) for name in categories}
            for sweep in others
        }
        closed = recovered(folder / CLOSING, "closing")
        closing = {
            name: _described(item, rows(folder / CLOSING, name, PAPER, few)) for name, item in closed.items()
        }
    figures: dict[str, Any] = {name: _described(found[name], drawn) for name, drawn in paper.items()}
    planned = [row for drawn in paper.values() for row in drawn if not row["reason"]]
    if planned:
        figures["ik"] = worst_ik(planned)
    return figures | {"beyond": beyond, CLOSING: closing}


def _described(found: Recovered, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Describe the input of the planning, and the metrics of its draws."""
    origin = {
        "world": found.world,
        "asset": found.fitted.asset.name,
        "demonstrations_refused": list(found.refused),
    }
    return origin | summary(rows)


def start_workers() -> Executor:
    """Start processes that share nothing, as OpenGL requires."""
    # The processes read these as they start: a second thread of the linear algebra would only wait.
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    return ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn"))


def _drawn(
    pool: Executor, job: Callable[[int], dict[str, Any]], attempts: int, notify: Notify
) -> Iterator[dict[str, Any]]:
    """Yield draws in order until `attempts` of them pass tier A; further ones that were begun are dropped."""
    waiting: deque[Future[dict[str, Any]]] = deque()
    good = 0
    for index in count():
        while len(waiting) < WORKERS:
            waiting.append(pool.submit(job, index + len(waiting)))
        row = waiting.popleft().result()
        good += not row["reason"]
        notify(f"{index} ({good} of {attempts}): {row}")
        yield row
        if good >= attempts or index + 1 >= MAX_DRAWS * attempts:
            break
    for future in waiting:
        future.cancel()
