"""kill -9 at every step of replacing a folder: the old one or the new one is there, whole."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("killed_replacing.py")
OLD, NEW = "a=old b=old", "a=new b=new"


@pytest.mark.parametrize("way", ["exchange", "two-renames"])
def test_a_folder_is_replaced_whole(tmp_path, way):
    command = [sys.executable, str(SCRIPT), str(tmp_path), way]
    lines = subprocess.run(
        command, capture_output=True, text=True, check=True, timeout=60
    ).stdout.splitlines()
    left = [line.split("|") for line in lines]
    states = [state for state, _ in left]
    assert len(states) > 20
    # Old until some step, new from then on; between two renames there may be nothing.
    changes = [a for a, b in zip(states, [*states[1:], ""], strict=True) if a != b]
    assert changes == ([OLD, NEW] if way == "exchange" else [OLD, "nothing", NEW])
    assert all(names == ("x" if state != "nothing" else "") for state, names in left), (
        "something was left over"
    )
