"""Runs that are disturbed by faults: episodes and dataset of a toy drawer, made as by `aomgen run`, in a child process."""

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

# Parameters of the toy run; drawers of a small scale do not open far enough, so some attempts are rejected.
PARAMS: Final = {
    "ranges": {"x_m": [-0.02, 0.05], "yaw_deg": [-15, 15], "scale": [0.5, 1.0]},
    "cameras": ["front"],
}
INPUTS: Final = "inputs"
# Inputs of the two stages, which no stage of this run makes.
NEEDED: Final = ("capture", "motion", "twin", "replacement", "review")
# Functions of `os` that change the disk: they open files for writing, make folders, rename, and synchronize.
OPERATIONS: Final = ("open", "mkdir", "replace", "fsync")
# Upper limit of the duration of a run, also on a busy computer, [s].
RUN_S: Final = 300.0

# Called with the name and the first argument of a file operation before it is done; raises, or kills the process.
Fault = Callable[[str, Any], None]


class Quiet:
    """A display without output."""

    def begin(self, stage: Stage, *, fresh: bool) -> None: ...

    def progress(self, share: float, text: str) -> None: ...

    def end(self, stage: Stage, seconds: float, figures: dict[str, Any]) -> None: ...

    def warn(self, stage: Stage, sentence: str) -> None: ...


class InThisProcess:
    """Executor that does a unit when its result is requested."""

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
    """Make missing or outdated episodes and dataset for inputs with a digest."""
    functions = {"episodes": partial(episodes_stage.run, on_done=heard), "dataset": export}

    def of_toy(name: str) -> Callable[..., dict[str, Any]]:
        return lambda _, folder, progress: functions[name](results, folder, progress)

    stages = tuple(replace(stage, function=of_toy(stage.name)) for stage in STAGES if stage.name in functions)
    run_stages(results.project, stages, Quiet(), inputs=dict.fromkeys(NEEDED, digest))


def make_here(out: Path, digest: str, workers: int) -> None:
    """Call `make` in a folder next to the inputs; the requested units are written to `told_file`.

    Args:
        out: Folder of the run.
        digest: Digest of its inputs.
        workers: Number of worker processes; 0 for this process only, in which the files of a worker are already open.
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
    """Request two episodes of one drawer."""
    return toy_results(scratch / INPUTS, params=PARAMS)


@cache
def open_here(scratch: Path) -> EpisodeFactory:
    """Open a worker that has already made an episode."""
    with scratch_folder(scratch) as folder:
        factory = EpisodeFactory(small_run(scratch), folder)
        factory.make(Unit(asset=0, index=0))
    return factory


def start_workers() -> Executor:
    """Start two processes that share no memory, as OpenGL requires."""
    # The processes read these variables when they start: a second thread of the linear algebra would only wait.
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    return ProcessPoolExecutor(2, mp_context=get_context("spawn"))


def told_file(out: Path) -> Path:
    """Return the file with the numbers of the units that a run has requested."""
    return out.with_suffix(".told")


def in_child(work: Callable[[], object], limit_s: float = RUN_S, method: str = "fork") -> int:
    """Do work in another process, and kill its process group after a time limit.

    Args:
        work: Pickled if the process is not a fork of this one.
        limit_s: Time after which it is killed, [s].
        method: "spawn" for work that does not survive a fork, for example Ray after its use in this process.

    Returns:
        0, the code of its error, or the negative number of the signal that ended it.
    """
    child = get_context(method).Process(target=_in_own_group, args=(work,))
    child.start()
    assert child.pid is not None
    with suppress(PermissionError, ProcessLookupError):  # the child has done so itself, and may have ended
        os.setpgid(child.pid, child.pid)
    child.join(limit_s)
    if child.exitcode is None:
        os.killpg(child.pid, signal.SIGKILL)
        child.join()
    assert child.exitcode is not None
    return child.exitcode


def _in_own_group(work: Callable[[], object]) -> None:
    os.setpgid(0, 0)
    # The child inherits the signals that the command blocks, and Ray ends its processes by a signal.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        work()
    except AomgenError as error:
        print(error, file=sys.stderr, flush=True)
        sys.exit(error.exit_code)


def at_operation(number: int, fault: Fault) -> Callable[[], int]:
    """Trigger the fault in this process before each file operation from this number on.

    Returns:
        A function that returns the number of operations that have begun.
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
