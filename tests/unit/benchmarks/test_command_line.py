"""The command line of the benchmarks refuses as the product's does."""

import subprocess
import sys
from pathlib import Path

from command_line import one_sentence

REPOSITORY = Path(__file__).parents[3]


def test_a_capture_without_ground_truth_is_not_scored(sample: Path) -> None:
    command = [sys.executable, "-m", "benchmarks", "accuracy", str(sample)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=300)
    one_sentence(done, 3, "cannot be scored")
