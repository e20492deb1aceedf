"""What faults are done to: episodes and dataset of a toy drawer, made as `aomgen run` makes them, in a killable child."""

import os
import signal
import sys
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, Self
from unittest.mock import patch

from aomgen.datasets.stage import run as export
from aomgen.episodes import stage as episodes_stage
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.ledger import Unit
from aomgen.errors import AomgenError
from aomgen.executors import Done, Work
from aomgen.io.atomic import scratch_folder
from aomgen.pipeline.runner import Stage, run_stages
from aomgen.pipeline.stages import STAGES
from toy_run import ToyResults, elsewhere, toy_results

# Draws of the toy; those that are small do not open far enough, so some attempts are rejected.
PARAMS: Final = {
    "ranges": {"x_m": [-0.02, 0.05], "yaw_deg": [-15, 15], "scale": [0.5, 1.0]},
    "cameras": ["front"],
}
INPUTS: Final = "inputs"
# What the two stages need, made by nobody here.
NEEDED: Final = ("capture", "motion", "twin", "replacement", "review")
# Calls of `os` that change the disk: files opened to be written, folders made, things put in place, and synced.
OPERATIONS: Final = ("open", "mkdir", "replace", "fsync")
# No run takes as long, not even on a busy machine, [s].
RUN_S: Final = 300.0

# Called with the name and the first argument of a file operation before it is done; raises, or kills.
Fault = Callable[[str, Any], None]


class Quiet:
    """A display that shows nothing."""

    def begin(self, stage: Stage, *, fresh: bool) -> None: ...

    def progress(self, share: float, text: str) -> None: ...

    def end(self, stage: Stage, seconds: float, figures: dict[str, Any]) -> None: ...

    def warn(self, stage: Stage, sentence: str) -> None: ...


class InThisProcess:
    """Does a unit when somebody waits for it."""

    slots = 1

    def __init__(self, work: Work) -> None:
        self._work, self._units = work, list[Any]()

    def submit(self, unit: Any) -> None:
        self._units.append(unit)

    def next_done(self) -> Done:
        unit = self._units.pop()
        return Done(unit=unit, value=self._work(unit))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None: ...


def make(results: ToyResults, digest: str, heard: Callable[[Done], None]) -> None:
    """Bring episodes and dataset up to date, for inputs of a digest."""
    functions = {"episodes": partial(episodes_stage.run, on_done=heard), "dataset": export}

    def of_toy(name: str) -> Callable[..., dict[str, Any]]:
        return lambda _, folder, progress: functions[name](results, folder, progress)

    stages = tuple(replace(stage, function=of_toy(stage.name)) for stage in STAGES if stage.name in functions)
    run_stages(results.project, stages, Quiet(), inputs=dict.fromkeys(NEEDED, digest))


def make_here(out: Path, digest: str, workers: int) -> None:
    """`make` in a folder beside the inputs; what is told to be done is written into `told_file`.

    Args:
        out: Of the run.
        digest: Of its inputs.
        workers: Processes; 0 for none but this one, which then has all open that a worker needs.
    """
    results = elsewhere(small_run(out.parent), out, workers=workers)
    with told_file(out).open("w") as file:

        def heard(done: Done) -> None:
            print(done.unit.number, file=file, flush=True)

        if workers:
            make(results, digest, heard)
            return
        factory = open_here(out.parent)
        factory.folder = results.folders["episodes"]
        with (
            patch.object(episodes_stage, "open_factory", lambda *_: factory.make),
            patch.object(episodes_stage, "open_executor", lambda _, opener, __: InThisProcess(opener())),
        ):
            make(results, digest, heard)


def small_run(scratch: Path) -> ToyResults:
    """Two episodes of one drawer."""
    return toy_results(scratch / INPUTS, params=PARAMS)


@cache
def open_here(scratch: Path) -> EpisodeFactory:
    """A worker that has made an episode already."""
    with scratch_folder(scratch) as folder:
        factory = EpisodeFactory(small_run(scratch), folder)
        factory.make(Unit(asset=0, index=0))
    return factory


def start_workers() -> Executor:
    """Two processes that share nothing, as OpenGL requires."""
    # Read by the processes as they start: a second thread of the linear algebra only waits.
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    return ProcessPoolExecutor(2, mp_context=get_context("spawn"))


def told_file(out: Path) -> Path:
    """Numbers of the units that a run has told to be done."""
    return out.with_suffix(".told")


def in_child(work: Callable[[], object], limit_s: float = RUN_S, method: str = "fork") -> int:
    """Do work in another process, and kill its group after a while.

    Args:
        work: Pickled if the process is not a fork of this one.
        limit_s: Afterwards it is killed.
        method: "spawn" for what does not survive a fork, as Ray after it was used here.

    Returns:
        0, the code of its error, or minus the number of the signal that ended it.
    """
    child = get_context(method).Process(target=_in_own_group, args=(work,))
    child.start()
    assert child.pid is not None
    with suppress(PermissionError, ProcessLookupError):  # it has done so itself, and has gone on or ended
        os.setpgid(child.pid, child.pid)
    child.join(limit_s)
    if child.exitcode is None:
        os.killpg(child.pid, signal.SIGKILL)
        child.join()
    assert child.exitcode is not None
    return child.exitcode


def _in_own_group(work: Callable[[], object]) -> None:
    os.setpgid(0, 0)
    # What the command blocks for itself is inherited, and Ray ends its processes by a signal.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        work()
    except AomgenError as error:
        print(error, file=sys.stderr, flush=True)
        sys.exit(error.exit_code)


def at_operation(number: int, fault: Fault) -> Callable[[], int]:
    """From the file operation of this number on, let the fault happen in this process before each.

    Returns:
        Tells how many have been begun.
    """
    begun = 0

    def faulty(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            nonlocal begun
            if name != "open" or arguments[1] & os.O_CREAT:
                begun += 1
                if begun >= number:
                    fault(name, arguments[0])
            return function(*arguments, **named)

        return call

    for name in OPERATIONS:
        setattr(os, name, faulty(name, getattr(os, name)))
    return lambda: begun
