"""The command line for tests, in a separate process or in this one."""

import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from subprocess import CompletedProcess
from unittest.mock import patch

from aomgen.cli.app import main


def started(*arguments: object, folder: Path) -> CompletedProcess:
    """Run the command line as a user does; the result includes the output of native libraries."""
    command = [sys.executable, "-c", "from aomgen.cli.app import main; main()", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


def aomgen(*arguments: object, folder: Path) -> CompletedProcess:
    """Run the command line in this process, which has already imported all modules."""
    words = ["aomgen", *map(str, arguments)]
    out, err, code = StringIO(), StringIO(), 0
    with chdir(folder), redirect_stdout(out), redirect_stderr(err), patch.object(sys, "argv", words):
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return CompletedProcess(words, code, out.getvalue(), err.getvalue())


def one_sentence(result: CompletedProcess, code: int, *words: str) -> None:
    assert result.returncode == code, result.stderr
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("error: ")
    for word in words:
        assert word in lines[0]
