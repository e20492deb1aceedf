"""Work for the tests of executors; a module, so that worker processes can import it."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from aomgen.errors import StorageError


def open_work(folder: Path) -> Callable[[str], tuple[str, int]]:
    """Open work that a unit's name selects; it writes a line whenever it begins."""
    (folder / f"opened-{os.getpid()}").touch()

    def work(unit: str) -> tuple[str, int]:
        with (folder / unit).open("a") as file:
            file.write("begun\n")
        times = len((folder / unit).read_text().splitlines())
        if unit.startswith("die") and times <= int(unit.removeprefix("die")):
            os.kill(os.getpid(), signal.SIGKILL)
        if unit == "hang":
            time.sleep(60)
        if unit == "fail":
            raise StorageError("disk", "is full", "free space")
        if unit == "bug":
            raise ZeroDivisionError("no")
        return unit, int(os.environ.get("OMP_NUM_THREADS", "0"))

    return work
