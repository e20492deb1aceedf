"""A command that a test stops while it works in different ways; a bug when asked for one."""

import ctypes
import signal
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from aomgen.cli.run import report_bug, stop_at_signals

WAIT_S = 60


def sleep_natively() -> None:
    """Wait in native code, where Python's signal handlers do not run."""
    ctypes.CDLL(None).poll(None, 0, 1000 * WAIT_S)


def main(work: str, begun: Path) -> None:
    """Begin the work, say so in a file, and wait."""
    sys.excepthook = report_bug
    with stop_at_signals():
        if work == "bug":
            raise KeyError("fx")
        scratch = tempfile.TemporaryDirectory()
        if work == "handler":
            # As pycolmap's import does for SIGTERM: a native handler takes the place of Python's.
            libc = ctypes.CDLL(None)
            for number in (signal.SIGINT, signal.SIGTERM):
                libc.signal(int(number), ctypes.cast(libc.abort, ctypes.c_void_p))
        begun.write_text("")
        if work == "pool":
            with ThreadPoolExecutor(2) as pool:
                pool.submit(sleep_natively)
                pool.submit(sleep_natively)
        sleep_natively()
        scratch.cleanup()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
