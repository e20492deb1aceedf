"""How a command ends that is stopped, or that meets a bug."""

import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("stopped_command.py")
INTERRUPTED = "interrupted; run the same command again to continue"


@pytest.fixture(autouse=True)
def terminal():
    """Commands are started as from a terminal, also where these tests themselves run in a script's background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def start(work: str, folder: Path, output: int) -> subprocess.Popen:
    """Start the stand-in command and wait until its work has begun."""
    environment = {**os.environ, "TMPDIR": str(folder)}
    command = [sys.executable, str(SCRIPT), work, str(folder / "begun")]
    process = subprocess.Popen(command, stdout=output, stderr=output, env=environment)
    deadline = time.monotonic() + 60
    while not (folder / "begun").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return process


@pytest.mark.parametrize("work", ["native", "handler", "pool"])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_the_command_at_once_with_one_line(tmp_path, work, number, code):
    reading, writing = os.pipe()
    process = start(work, tmp_path, writing)
    os.close(writing)
    sent = time.monotonic()
    process.send_signal(number)
    assert process.wait(timeout=30) == code
    assert time.monotonic() - sent < 3
    with os.fdopen(reading) as file:
        assert file.read() == INTERRUPTED + "\n"
    assert [path.name for path in tmp_path.iterdir()] == ["begun"], "temporary files stay"


def test_on_a_terminal_the_bar_is_left_and_the_cursor_shown(tmp_path):
    master, terminal = pty.openpty()
    process = start("native", tmp_path, terminal)
    os.close(terminal)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=30) == 143
    assert os.read(master, 1000).decode() == f"\r\x1b[2K\x1b[?25h{INTERRUPTED}\r\n"
    os.close(master)


def test_a_command_whose_output_nobody_reads_ends_too(tmp_path):
    reading, writing = os.pipe()
    process = start("native", tmp_path, writing)
    os.close(writing)
    os.close(reading)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=30) == 143


def test_ctrl_c_stays_ignored_in_the_background_of_a_script(tmp_path):
    """Shells without job control start background jobs with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        process = start("native", tmp_path, subprocess.DEVNULL)
    finally:
        signal.signal(signal.SIGINT, before)
    process.send_signal(signal.SIGINT)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(timeout=0.5)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=30) == 143


def test_no_thread_starts_before_the_signals_are_blocked():
    """NumPy starts threads when it is imported; a signal could end in one of them, and in a native handler."""
    script = "import sys, aomgen.cli.app; print(sorted({'numpy', 'torch', 'pycolmap'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_a_bug_is_called_one_and_keeps_its_traceback(tmp_path):
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    command = [sys.executable, str(SCRIPT), "bug", str(tmp_path / "begun")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 70
    (trace,) = tmp_path.glob("aomgen-bug-*.txt")
    assert done.stderr == (
        f"error: this is a bug in AOMGen (KeyError: 'fx'); please report it with {trace}\n"
    )
    assert 'raise KeyError("fx")' in trace.read_text()
