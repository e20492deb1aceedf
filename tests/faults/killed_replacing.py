"""Kills itself at every step of replacing a folder and prints what each kill leaves; see the test."""

import os
import signal
import sys
from pathlib import Path

from aomgen.io import atomic
from aomgen.io.atomic import remove_staging, stage_folder, write_text


def die_at(step: int) -> None:
    """Die before the system call of this number: files opened, folders made, renamed, locked, deleted."""
    left = step

    def count(event: str, arguments: tuple) -> None:
        nonlocal left
        if event.startswith(("open", "os.", "shutil.", "fcntl.", "ctypes.dlsym")):
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(count)


def fill(path: Path, text: str) -> None:
    """Replace a folder by one with two files."""
    with stage_folder(path) as folder:
        for name in "ab":
            write_text(folder / name, text)


def content(folder: Path) -> str:
    return " ".join(
        sorted(f"{p.relative_to(folder)}={p.read_text()}" for p in folder.rglob("*") if p.is_file())
    )


def main(place: Path, exchange: bool) -> None:
    """Kill children at step 1, 2, ... until one comes to its end; one line each."""
    if not exchange:
        atomic.RENAME_EXCHANGE = 1 << 20  # unknown to every file system, so it refuses
    status, step = -1, 0
    while status:
        step += 1
        fill(place / "x", "old")
        child = os.fork()
        if child == 0:
            die_at(step)
            fill(place / "x", "new")
            os._exit(0)
        status = os.waitpid(child, 0)[1]
        left = content(place / "x")
        remove_staging(place)
        sys.stdout.write(f"{left or 'nothing'}|{' '.join(sorted(p.name for p in place.iterdir()))}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2] == "exchange")
