"""`python -m benchmarks faults`: faults of toy runs, which are helpers of the tests."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from faults import run_faults as run_faults
