"""Execution of units of work, and the executor with processes on this machine.

A unit may be executed twice, if its worker dies between the work and the reply, so work must be idempotent.
"""

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, Final, Protocol, Self

from aomgen.errors import WorkerError

# `Work` is a function that executes a unit. `Opener` is a function that returns it; it is pickled and called once in each worker.
Work = Callable[[Any], Any]
Opener = Callable[[], Work]
# Number of retries of a unit whose worker died.
RETRIES: Final = 2
# Reasons why a unit has no result, see `Done.lost`.
LOST: Final = {
    "worker_died": "the process that worked on it died repeatedly",
    "timeout": "it took longer than the limit",
}
# Every worker uses one thread, so that results do not depend on the number of workers and workers do not compete for cores.
ONE_THREAD: Final = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


@dataclass(frozen=True, slots=True, kw_only=True)
class Done:
    """Result of a unit: its value; or, in `lost`, the reason why there is none: "worker_died" or "timeout"."""

    unit: Any
    value: Any = None
    lost: str = ""


class Executor(Protocol):
    """Executor of units; `slots` is the largest number of units that may run at the same time."""

    slots: int

    def submit(self, unit: Any) -> None:
        """Start the execution of a unit."""
        ...

    def next_done(self) -> Done:
        """Wait until a unit has ended, and return its result, or raise the error of its work."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *exception: object) -> None: ...


def run_units(units: Iterable[Any], executor: Executor) -> Iterator[Done]:
    """Execute units and yield each result as soon as it is available; the executor is closed at the end.

    Raises:
        WorkerError: A unit terminates its process, or takes too long.
        AomgenError: The work of a unit fails.
    """
    for done in try_units(units, executor):
        if done.lost:
            raise WorkerError(f"unit {done.unit}", f"has no result: {LOST[done.lost]}", "try fewer --workers")
        yield done


def try_units(units: Iterable[Any], executor: Executor) -> Iterator[Done]:
    """Execute units as `run_units` does, but also yield those that were lost."""
    waiting, running = iter(units), 0
    with executor:
        while True:
            for unit in islice(waiting, executor.slots - running):
                executor.submit(unit)
                running += 1
            if not running:
                return
            yield executor.next_done()
            running -= 1


class _Worker:
    """A worker process and its current unit."""

    def __init__(self, opener: Opener) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        # Not a daemon process, which may not start processes: the work may itself use an executor.
        self.process: BaseProcess = context.Process(target=_serve, args=(opener, theirs))
        with _environment(ONE_THREAD), _without_script():
            self.process.start()
        theirs.close()
        self.unit: Any = None
        self.began = 0.0

    def begin(self, unit: Any) -> None:
        """Send a unit to the process."""
        self.unit, self.began = unit, time.monotonic()
        self.connection.send(unit)

    def kill(self) -> None:
        """Kill the process and close the connection to it."""
        self.process.kill()
        self.process.join()
        self.connection.close()


class Processes:
    """Executor with worker processes on this machine, which are started when they are needed.

    Args:
        opener: Function that each worker calls once.
        slots: Largest number of workers.
        timeout_s: Time limit of a unit, [s].
    """

    def __init__(self, opener: Opener, slots: int, timeout_s: float) -> None:
        self.slots = slots
        self._opener, self._timeout_s = opener, timeout_s
        self._workers: list[_Worker] = []
        self._deaths: dict[Any, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        for worker in self._workers:
            worker.kill()

    def submit(self, unit: Any) -> None:
        """Start the execution of a unit in an idle worker, or in a new one."""
        idle = next((worker for worker in self._workers if worker.unit is None), None)
        if idle is None:
            idle = _Worker(self._opener)
            self._workers.append(idle)
        try:
            idle.begin(unit)
        except OSError:  # The worker has died since its last unit.
            self._remove(idle)
            self.submit(unit)

    def next_done(self) -> Done:
        """Wait until a unit has ended or exceeded the time limit, and return its result, or raise the error of its work."""
        while True:
            busy = {worker.connection: worker for worker in self._workers if worker.unit is not None}
            left_s = self._timeout_s - (time.monotonic() - min(worker.began for worker in busy.values()))
            for connection in wait(list(busy), max(left_s, 0.0)):
                done = self._answer(busy[connection])  # type: ignore[index]
                if done is not None:
                    return done
            for worker in list(self._workers):  # Workers that died are no longer in the list.
                if worker.unit is not None and time.monotonic() - worker.began > self._timeout_s:
                    self._remove(worker)
                    return Done(unit=worker.unit, lost="timeout")

    def _answer(self, worker: _Worker) -> Done | None:
        """Receive a worker's reply; None if the worker has died and its unit was started again."""
        unit = worker.unit
        try:
            value, error = worker.connection.recv()
        except (EOFError, OSError):
            self._remove(worker)
            self._deaths[unit] = self._deaths.get(unit, 0) + 1
            if self._deaths[unit] > RETRIES:
                return Done(unit=unit, lost="worker_died")
            self.submit(unit)
            return None
        worker.unit = None
        if error is not None:
            raise error
        return Done(unit=unit, value=value)

    def _remove(self, worker: _Worker) -> None:
        worker.kill()
        self._workers.remove(worker)


def _serve(opener: Opener, connection: Connection) -> None:
    """Execute units in a worker process until the parent closes the connection."""
    # Signals are reset, because the process inherits blocked and ignored signals from its parent.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    work: Work | None = None
    while True:
        try:
            unit = connection.recv()
        except EOFError:
            return
        try:
            work = work or opener()
            answer = work(unit), None
        except Exception as error:
            error.add_note(traceback.format_exc())
            answer = None, error
        connection.send(answer)


def _end_with_parent() -> None:
    """End this process when its parent dies, because its result could not be committed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


@contextmanager
def _without_script() -> Iterator[None]:
    """Hide the caller's script from processes that are started in the block.

    A spawned process executes the script of its parent again; a script without `if __name__ == "__main__"` would then start
    the same work again. Workers do not need the script, because openers are pickled by the names of their modules.
    """
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


@contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for processes that are started in the block."""
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
