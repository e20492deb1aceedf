"""How the commands run: a project in a terminal, the project that a path means, and ends by a signal or a bug."""

import importlib.resources
import os
import shlex
import shutil
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import typer

from aomgen import __version__
from aomgen.errors import AomgenError, ConfigError, EstimationError, InputError, MissingFileError

# Name of the bundled recording, in `aomgen.samples`.
SAMPLE = "microwave-a"
INTERRUPTED = "interrupted; run the same command again to continue\n"
# Back to the line's start, delete it, show the cursor: a progress bar hides it.
LEAVE_BAR = "\r\x1b[2K\x1b[?25h"
# What BSD's sysexits.h calls an internal software error.
EXIT_BUG = 70
# Settings of every command line of the repository.
COMMAND_LINE: Final[dict[str, Any]] = {
    "add_completion": False,
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
    with stop_at_signals():
        try:
            # Not `app()`, which sets an excepthook of its own.
            typer.main.get_command(app)()
        except AomgenError as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(error.exit_code)
        except PermissionError as error:
            print(f"error: {error.filename}: {error.strerror}; change who may use it", file=sys.stderr)
            sys.exit(InputError.exit_code)


def describe_command() -> str:
    """The command that runs, as a user would type it."""
    script = Path(sys.argv[0])
    program = ["python", "-m", script.parent.name] if script.name == "__main__.py" else ["aomgen"]
    return shlex.join([*program, *sys.argv[1:]])


def run_project(project, *, until: str = "", **machine):
    """Run the pipeline with a display and say where the results are; `machine` as in `run_pipeline`.

    Raises:
        ConfigError: The results would go where a file is.
        AomgenError: Whatever a stage refuses.
    """
    from aomgen.cli.display import display
    from aomgen.motion.estimates_file import forget_refusal
    from aomgen.pipeline.manifest import RunRecord, save_record
    from aomgen.pipeline.stages import REPORT_FILE, run_pipeline

    if project.out.exists() and not project.out.is_dir():
        raise ConfigError(project.out, "is a file, and results need a folder", "choose another name")
    forget_refusal(project.out)
    try:
        with display() as shown:
            changed = run_pipeline(project, shown, until=until, **machine)
    except EstimationError as error:
        from aomgen.report.motion_section import write_refusal

        page = write_refusal(project.out, str(error))
        if page is not None:
            print(f"evidence {page}", file=sys.stderr)
        raise
    if changed:
        command = describe_command()
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        save_record(project.out, RunRecord(command=command, version=__version__, finished=now))
    if not until:
        if changed or not (project.out / REPORT_FILE).exists():
            from aomgen.report.page import write_report

            write_report(project.out)
        print(f"dataset  {project.out / 'dataset'}")
        print(f"report   {project.out / 'report.html'}")


def sample_capture() -> Path:
    """Folder of the bundled recording."""
    return (Path(str(importlib.resources.files("aomgen.samples"))) / SAMPLE).resolve()


def status_lines(project) -> tuple[list[str], bool]:
    """What `aomgen status` says of a run, and whether something is still to be made."""
    from aomgen.episodes.ledger import read_accounts
    from aomgen.pipeline.manifest import read_manifest
    from aomgen.pipeline.runner import stage_states
    from aomgen.pipeline.stages import STAGES

    lines, left = [], False
    for stage, state in stage_states(project, STAGES):
        folder = project.out / stage.folder
        lines.append(f"{state:8} {stage.folder:18} {stage.title}")
        left |= state != "done"
        manifest = read_manifest(folder)
        lines += [f"         warning: {sentence}" for sentence in (manifest.warnings if manifest else ())]
        for account in read_accounts(folder) if stage.name == "episodes" else ():
            lines.append(
                f"         {account.asset}: {account.requested} requested = {account.committed} committed + "
                f"{account.rejected} rejected + {account.left} left, after {account.attempts} attempts"
                + (f" ({account.why})" if account.why else "")
            )
    return lines, left


def find_project(path: Path):
    """The project that a path means: a project file, or the folder of a run, wherever that has been moved.

    Raises:
        MissingFileError: There is nothing of both.
        ConfigError: The project file is not valid.
    """
    from aomgen.pipeline.project_file import read_project
    from aomgen.pipeline.stages import PROJECT_FILE, STAGES

    remedy = "give the folder of a run, or a project file"
    if not path.exists():
        raise MissingFileError(path, "is missing", remedy)
    if not path.is_dir():
        return read_project(path)
    file = path / PROJECT_FILE
    if not file.is_file():
        raise MissingFileError(path, f"holds no {PROJECT_FILE}", remedy)
    project = read_project(file)
    has_results = any((path / stage.folder).is_dir() for stage in STAGES)
    return project.model_copy(update={"out": path.resolve()}) if has_results else project


@contextmanager
def stop_at_signals() -> Iterator[None]:
    """While the block runs, SIGINT and SIGTERM end the process with exit code 130 or 143.

    Whatever native code and other threads are doing: the signals are blocked and a thread waits for them. Native
    libraries install handlers of their own, and Python's run only between two lines of Python. The
    process may end at any line, since results are committed by renaming: the next run deletes what is
    half-written. Temporary files all go into one folder, which is deleted here.

    Call it before any other thread starts, as those of NumPy do when it is imported: threads inherit what
    is blocked.
    """
    numbers = [
        number
        for number in (signal.SIGINT, signal.SIGTERM)
        # A job in the background of a script ignores Ctrl-C.
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
    """End the process; writes past Python's streams, which another thread may hold."""
    try:
        shutil.rmtree(scratch, ignore_errors=True)
        if os.isatty(2):
            os.write(2, (LEAVE_BAR + INTERRUPTED).encode())
        else:
            if os.isatty(1):
                os.write(1, LEAVE_BAR.encode())
            os.write(2, INTERRUPTED.encode())
    finally:
        # Also when nobody reads any more.
        os._exit(128 + number)


def report_bug(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """An `excepthook`: one line that says it is a bug and where its traceback lies; exit code 70.

    Raises:
        SystemExit: Always.
    """
    # NumPy comes with it, whose threads would not have the signals blocked.
    from aomgen.io.atomic import write_text

    path = Path(tempfile.gettempdir()) / f"aomgen-bug-{os.getpid()}.txt"
    command = " ".join(sys.argv)
    lines = traceback.format_exception(kind, error, trace)
    write_text(path, f"aomgen {__version__}: {command}\n{''.join(lines)}")
    what = traceback.format_exception_only(kind, error)[-1].splitlines()[0]
    print(f"error: this is a bug in AOMGen ({what}); please report it with {path}", file=sys.stderr)
    sys.exit(EXIT_BUG)
