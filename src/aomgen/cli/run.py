"""Execution of commands: running a project in a terminal, and exits by an error, a signal or a bug."""

import importlib.resources
import os
import shutil
import signal
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from aomgen.errors import AomgenError, EstimationError, InputError, explain_missing_module
from aomgen.version import __version__

if TYPE_CHECKING:
    from aomgen.core.project import Project

# Name of the bundled recording, in `aomgen.samples`.
SAMPLE = "microwave-a"
RunFolder = Annotated[Path, typer.Argument(help="Folder of a run, or its project file.")]
INTERRUPTED = "interrupted; run the same command again to continue\n"
# Terminal codes: return to the start of the line, delete it, and show the cursor, which a progress bar hides.
LEAVE_BAR = "\r\x1b[2K\x1b[?25h"
PYTHON_FORMAT: Final = warnings.formatwarning
# Exit code of an internal software error in BSD's sysexits.h.
EXIT_BUG = 70
# Settings of every command line of the repository.
COMMAND_LINE: Final[dict[str, Any]] = {
    "no_args_is_help": True,
    "pretty_exceptions_enable": False,
    "rich_markup_mode": None,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}


def run_command(app: typer.Typer) -> None:
    """Run the command that `sys.argv` names; an `AomgenError` becomes one sentence and its exit code.

    Raises:
        SystemExit: Always, with the command's exit code.
    """
    sys.excepthook = report_bug
    warnings.formatwarning = format_warning
    with stop_at_signals():
        try:
            try:
                # Not `app()`, which sets another excepthook.
                typer.main.get_command(app)()
            except ModuleNotFoundError as error:
                missing = explain_missing_module(error)
                if missing is None:
                    raise
                raise missing from error
        except AomgenError as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(error.exit_code)
        except PermissionError as error:
            print(f"error: {error.filename}: {error.strerror}; change the permissions", file=sys.stderr)
            sys.exit(InputError.exit_code)


def run_project(project: "Project", *, until: str = "", **machine: Any) -> None:
    """Run the pipeline with a display and print where the results are; `machine` as in `Results`.

    Raises:
        AomgenError: See `bring_up_to_date`.
    """
    from aomgen.api.run import bring_up_to_date
    from aomgen.motion.estimates_file import REFUSED_FILE

    try:
        bring_up_to_date(project, until=until, **machine)
    except EstimationError:
        page = project.out / REFUSED_FILE
        if page.is_file():
            print(f"evidence {page}", file=sys.stderr)
        raise
    if not until:
        print(f"dataset  {project.out / 'dataset'}")
        print(f"report   {project.out / 'report.html'}")


def sample_capture() -> Path:
    """Return the folder of the bundled recording."""
    return (Path(str(importlib.resources.files("aomgen.samples"))) / SAMPLE).resolve()


def status_lines(project: "Project") -> tuple[list[str], bool]:
    """Return the lines that `aomgen status` prints, and whether the run is incomplete."""
    from aomgen.episodes.ledger import ACCOUNTS, Account, read_accounts
    from aomgen.pipeline.runner import stage_manifests
    from aomgen.pipeline.stages import STAGES

    lines, left = [], False
    for stage, state, manifest in stage_manifests(project, STAGES):
        folder = project.out / stage.folder
        lines.append(f"{state:8} {stage.folder:18} {stage.title}")
        left |= state != "done"
        lines += [f"         warning: {sentence}" for sentence in (manifest.warnings if manifest else ())]
        if stage.name != "episodes":
            continue
        # The accounts of a finished stage are among its metrics; those of another one are counted.
        stated = manifest.figures.get(ACCOUNTS) if manifest and state == "done" else None
        accounts = read_accounts(folder) if stated is None else [Account(**item) for item in stated]
        for account in accounts:
            lines.append(
                f"         {account.asset}: {account.committed} of {account.requested} episodes committed, "
                f"{account.rejected} missing, {account.left} remaining; {account.attempts} samples planned"
                + (f" (rejected or skipped: {account.why})" if account.why else "")
            )
    return lines, left


@contextmanager
def stop_at_signals() -> Iterator[None]:
    """End the process with exit code 130 or 143 at SIGINT or SIGTERM while the block runs.

    The signals are blocked and a separate thread waits for them, so that native code and other threads cannot
    delay them: native libraries install their own handlers, and Python's handlers run only between two Python
    instructions. The process may end at any line, because results are committed by renaming, and the next run
    deletes incomplete files. All temporary files are in one folder, which is deleted here.

    Enter the block before any other thread starts (NumPy starts some when it is imported), because threads
    inherit the set of blocked signals.
    """
    numbers = [
        number
        for number in (signal.SIGINT, signal.SIGTERM)
        # A background job of a script ignores SIGINT; this is preserved.
        if signal.getsignal(number) is not signal.SIG_IGN
    ]
    over = threading.Event()
    with tempfile.TemporaryDirectory(prefix="aomgen-") as scratch:

        def wait() -> None:
            number = signal.sigwait([*numbers, signal.SIGUSR1])
            if not over.is_set():
                _end(number, scratch)

        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [*numbers, signal.SIGUSR1])
        before, tempfile.tempdir = tempfile.tempdir, scratch
        waiting = threading.Thread(target=wait, daemon=True)
        waiting.start()
        try:
            yield
        finally:
            over.set()
            signal.pthread_kill(waiting.ident or 0, signal.SIGUSR1)
            waiting.join()
            tempfile.tempdir = before
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _end(number: int, scratch: str) -> None:
    """End the process; write to the file descriptors directly, because another thread may hold Python's streams."""
    try:
        shutil.rmtree(scratch, ignore_errors=True)
        if os.isatty(2):
            os.write(2, (LEAVE_BAR + INTERRUPTED).encode())
        else:
            if os.isatty(1):
                os.write(1, LEAVE_BAR.encode())
            os.write(2, INTERRUPTED.encode())
    finally:
        # Also when no process reads the stream any more.
        os._exit(128 + number)


def format_warning(message: Warning | str, category: type[Warning], *where: Any, **line: Any) -> str:
    """Format a warning of AOMGen as one sentence, and a warning of another package as Python does."""
    from aomgen.io.reuse import StoredFileWarning

    if issubclass(category, StoredFileWarning):
        return f"warning: {message}\n"
    return PYTHON_FORMAT(message, category, *where, **line)


def report_bug(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print one line with the bug and the path of its traceback, and exit with code 70; used as `sys.excepthook`.

    Raises:
        SystemExit: Always.
    """
    # Imported late, because it imports NumPy, whose threads would start before the signals are blocked.
    from aomgen.io.atomic import write_text

    path = Path(tempfile.gettempdir()) / f"aomgen-bug-{os.getpid()}.txt"
    command = " ".join(sys.argv)
    lines = traceback.format_exception(kind, error, trace)
    write_text(path, f"aomgen {__version__}: {command}\n{''.join(lines)}")
    what = traceback.format_exception_only(kind, error)[-1].splitlines()[0]
    print(f"error: this is a bug in AOMGen ({what}); please report it with {path}", file=sys.stderr)
    sys.exit(EXIT_BUG)
