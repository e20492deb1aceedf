"""Work of a corpus for tests; a module, so that worker processes can import it."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

from aomgen.executors import Done, Work


def open_stub(out: Path) -> Work:
    """Open the work that a capture's name selects: to finish, to fail, or to kill its process the first time or always."""

    def work(name: str) -> str:
        (out / name).mkdir(parents=True, exist_ok=True)
        with (out / name / "begun").open("a") as file:
            file.write("begun\n")
        first = len((out / name / "begun").read_text().splitlines()) == 1
        if name == "kills-always" or (name == "kills-once" and first):
            os.kill(os.getpid(), signal.SIGKILL)
        return "demo/joints.csv: is missing" if name == "fails" else ""

    return work


class InThisProcess:
    """Executor for work that neither terminates its process nor hangs."""

    slots = 1

    def __init__(self, opener: Callable[[], Work], *_: object) -> None:
        self._work = opener()

    def __enter__(self) -> "InThisProcess":
        return self

    def __exit__(self, *exception: object) -> None: ...

    def submit(self, unit: str) -> None:
        self._unit = unit

    def next_done(self) -> Done:
        return Done(unit=self._unit, value=self._work(self._unit))
