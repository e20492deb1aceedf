"""kill -9 during training costs at most the iterations since the last checkpoint, and changes nothing."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from aomgen.io.atomic import remove_staging

SCRIPT = Path(__file__).with_name("killed_training.py")


def start(folder: Path) -> subprocess.Popen:
    folder.mkdir(exist_ok=True)
    return subprocess.Popen([sys.executable, str(SCRIPT), str(folder)], stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_killed_trainings_end_in_the_same_bytes(tmp_path: Path) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert start(whole).wait(timeout=120) == 0
    rng = np.random.default_rng(0)
    begins = []
    for lines in (3, 5):
        process = start(broken)
        assert process.stdout is not None
        shares = [float(process.stdout.readline()) for _ in range(lines)]
        begins.append(shares[0])
        try:
            process.wait(timeout=float(rng.uniform(0.0, 0.05)))
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL, "it was not killed, so nothing was tested"
        remove_staging(broken)
    assert begins[0] < begins[1], "a killed training did not continue"
    assert start(broken).wait(timeout=120) == 0
    for name in ("result.npz", "training.checkpoint"):
        assert (broken / name).read_bytes() == (whole / name).read_bytes()
