"""kill -9 at any moment of generation loses nothing that was acknowledged, and the rest follows."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np

from aomgen.io.episode_folder import list_committed, read_episode

SCRIPT = Path(__file__).with_name("killed_run.py")
KILLS = 8


def start(out: Path) -> subprocess.Popen:
    """Start the run and wait until it works."""
    process = subprocess.Popen([sys.executable, str(SCRIPT), str(out)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    return process


def tree(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


def test_killed_runs_end_in_the_same_bytes(tmp_path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert start(whole).wait(timeout=60) == 0
    rng = np.random.default_rng(0)
    killed = 0
    acknowledged: set[Path] = set()
    for _ in range(KILLS):
        process = start(broken)
        try:
            process.wait(timeout=float(rng.uniform(0.0, 0.5)))
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            killed += 1
        committed = set(list_committed(broken / "episodes"))
        assert acknowledged <= committed, "an acknowledged episode is gone"
        for folder in committed:
            read_episode(folder)
        acknowledged = committed
    assert killed >= 2, "nothing was killed, so nothing was tested"
    assert start(broken).wait(timeout=60) == 0
    for name in ("episodes", "dataset"):
        assert tree(broken / name) == tree(whole / name)
