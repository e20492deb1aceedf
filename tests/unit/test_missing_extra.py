"""The library and the command line without the extra `reconstruct`."""

import subprocess
import sys
from pathlib import Path

import pytest

REMEDY = "torch: is not installed; pip install 'aomgen[reconstruct]'"
WITHOUT_TORCH = """
import sys
class WithoutTorch:
    def find_spec(self, name, path, target=None):
        if name == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name=name)
sys.meta_path.insert(0, WithoutTorch())
"""


@pytest.mark.parametrize(
    ("program", "code"),
    [
        ("import aomgen as ag; ag.generate", 1),
        ("sys.argv = ['aomgen', 'splat', '.', 'scene.ply']; from aomgen.cli.app import main; main()", 4),
    ],
)
def test_a_missing_package_is_named_with_its_extra(tmp_path: Path, program: str, code: int) -> None:
    command = [sys.executable, "-c", WITHOUT_TORCH + program]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert ended.returncode == code
    assert ended.stderr.strip().splitlines()[-1].endswith(REMEDY)
