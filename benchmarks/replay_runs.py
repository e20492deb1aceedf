"""Draws of `aomgen bench replay` on two processes, until there are enough attempts."""

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from functools import partial
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

from aomgen.errors import EstimationError
from aomgen.replacement.stage import require_opening
from benchmarks.recovered import recover
from benchmarks.replay import BEYOND, PAPER, Sweep, measure, summary, worst_ik

CATEGORIES: Final = ("microwave", "toolbox", "laptop", "drawer", "cabinet")
# Processes, each on one thread: the reference machine has two cores.
WORKERS: Final = 2
# Draws for each attempt before a sweep is given up; and attempts of the sweeps beyond the paper's for each of its own.
MAX_DRAWS, BEYOND_SHARE = 20, 0.1
Tell = Callable[[str], None]


def run_replay_bench(
    folder: Path,
    attempts: int,
    seed: int,
    tell: Tell,
    categories: tuple[str, ...] = CATEGORIES,
    others: tuple[Sweep, ...] = BEYOND,
) -> dict[str, Any]:
    """Figures by category, then those of `ik` over all of them, of sweeps `beyond`, and of `closing`.

    Args:
        folder: Keeps demonstrations and draws; a bench that was killed goes on.
        attempts: Draws wanted that pass tier A, in each category.
        seed: Of the first motion world, and of all draws.
        tell: Hears about every draw.
        categories: What is opened.
        others: Sweeps beyond the paper's.
    """
    with start_workers() as pool:
        jobs = {name: pool.submit(recover, name, seed, folder / name) for name in categories}
        found = {name: job.result() for name, job in jobs.items()}
        for name, item in found.items():
            tell(f"{name}: world {item.world}, {item.fitted.asset.name}; refused {list(item.refused)}")

        def rows(category: str, sweep: Sweep, wanted: int) -> list[dict[str, Any]]:
            return list(_drawn(pool, partial(measure, folder, category, sweep, seed), wanted, tell))

        paper = {name: rows(name, PAPER, attempts) for name in categories}
        few = max(1, round(BEYOND_SHARE * attempts))
        beyond = {
            sweep.name: {name: summary(rows(name, sweep, few)) for name in categories} for sweep in others
        }
    figures: dict[str, Any] = {
        name: {
            "world": found[name].world,
            "asset": found[name].fitted.asset.name,
            "demonstrations_refused": list(found[name].refused),
        }
        | summary(drawn)
        for name, drawn in paper.items()
    }
    planned = [row for drawn in paper.values() for row in drawn if not row["reason"]]
    if planned:
        figures["ik"] = worst_ik(planned)
    return figures | {"beyond": beyond, "closing": _closing()}


def start_workers() -> Executor:
    """Processes that share nothing, as OpenGL wants it."""
    # Read by the processes as they start: a second thread of the linear algebra only waits.
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    return ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn"))


def _drawn(
    pool: Executor, job: Callable[[int], dict[str, Any]], attempts: int, tell: Tell
) -> Iterator[dict[str, Any]]:
    """Draws in order, so many that `attempts` of them pass tier A; those that were begun beyond are dropped."""
    waiting: deque[Future[dict[str, Any]]] = deque()
    good = 0
    for index in count():
        while len(waiting) < WORKERS:
            waiting.append(pool.submit(job, index + len(waiting)))
        row = waiting.popleft().result()
        good += not row["reason"]
        tell(f"{index} ({good} of {attempts}): {row}")
        yield row
        if good >= attempts or index + 1 >= MAX_DRAWS * attempts:
            break
    for future in waiting:
        future.cancel()


def _closing() -> dict[str, Any]:
    """Whether demonstrations that close their object can be generalized, and why not."""
    try:
        require_opening("closing")
    except EstimationError as error:
        return {"supported": False, "reason": str(error)}
    return {"supported": True}
