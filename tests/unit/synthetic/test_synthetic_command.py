"""`python -m synthetic` as a user runs it."""

import subprocess
import sys
from pathlib import Path

import pytest

from aomgen.capture.read import read_capture
from command_line import one_sentence

REPOSITORY = Path(__file__).parents[3]


def make(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "synthetic", *map(str, arguments)]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=600)


def test_an_existing_folder_is_refused(tmp_path: Path) -> None:
    one_sentence(make(tmp_path), 2, "exists already")


@pytest.mark.slow
def test_a_capture_is_made(tmp_path: Path) -> None:
    done = make(tmp_path / "capture", "--category", "drawer", "--seed", 1)
    assert done.returncode == 0, done.stderr
    assert len(read_capture(tmp_path / "capture").scan_images) == 40
    assert (tmp_path / "capture" / "truth" / "truth.json").is_file()
