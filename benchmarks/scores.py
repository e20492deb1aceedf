"""All scores in one file, to be compared before and after a change: accuracy, alignment, intervals, speed.

Each part runs as a command of its own and leaves one JSON in the folder; a second call runs what is missing.
"""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from aomgen.errors import ConfigError
from aomgen.io.atomic import write_json

SCORES_FILE = "scores.json"
# Enough worlds and starts that one odd case does not move a median.
SYNTHETIC, MOTION_WORLDS, JOINT_WORLDS, ALIGNMENT_STARTS = 5, 50, 200, 60
# Kept beside the figures, no scores: every single world, timings of single rows.
ROWS = {"worlds", "rows", "captures"}
# Figures that differ less than this share are the same.
SAME_SHARE = 0.02


def run_scores(
    folder: Path, captures: list[Path], seed: int, tell: Callable[[str], None]
) -> dict[str, float]:
    """Run every part that is missing in the folder, and write all figures to `scores.json`.

    Args:
        folder: Runs, and one JSON a part.
        captures: With ground truth.
        seed: First seed of made captures and worlds; one that no constant was chosen on.
        tell: Hears which part runs.

    Returns:
        Figures by dotted name.

    Raises:
        ConfigError: A part failed; its output has been shown.
    """
    folder.mkdir(parents=True, exist_ok=True)
    parts = _parts(folder, captures, seed)
    for name, arguments in parts.items():
        result = folder / f"{name}.json"
        if result.is_file():
            tell(f"{name}: kept")
            continue
        tell(f"{name}: aomgen {' '.join(arguments)}")
        started = time.monotonic()
        done = subprocess.run([str(Path(sys.executable).with_name("aomgen")), *arguments], check=False)
        if done.returncode != 0:
            raise ConfigError(
                f"part '{name}' of the scores",
                f"ended with exit code {done.returncode}",
                "see above, and rerun",
            )
        if name == "demo":
            write_json(result, {"seconds": time.monotonic() - started})
    figures = {
        figure: value
        for name in parts
        for figure, value in flatten(name, json.loads((folder / f"{name}.json").read_text("utf-8")))
    }
    write_json(folder / SCORES_FILE, figures)
    return figures


def _parts(folder: Path, captures: list[Path], seed: int) -> dict[str, list[str]]:
    """Arguments of each part's command, by name."""

    def accuracy(name: str, *arguments: str) -> list[str]:
        return [*["bench", "accuracy"], *arguments, "--out", str(folder / name)]

    parts = {path.name: accuracy(path.name, str(path)) for path in captures}
    parts["synthetic"] = accuracy("synthetic", "--synthetic", str(SYNTHETIC), "--seed", str(seed))
    parts["motion"] = accuracy("motion", "--synthetic-motion", str(MOTION_WORLDS), "--seed", str(seed))
    parts["intervals"] = ["bench", "intervals", "--worlds", str(JOINT_WORLDS), "--seed", str(seed)]
    if captures:
        starts = ["--starts", str(ALIGNMENT_STARTS), "--seed", str(seed)]
        parts["alignment"] = ["bench", "alignment", *(str(path) for path in captures), *starts]
    parts["splatting"] = ["bench", "splatting"]
    written = {name: [*part, "--json", str(folder / f"{name}.json")] for name, part in parts.items()}
    return written | {"demo": ["demo", str(folder / "demo")]}


def flatten(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Numbers of nested JSON under dotted names."""
    if isinstance(value, int | float):
        yield name, float(value)
    elif isinstance(value, dict):
        for key, item in value.items():
            if key not in ROWS:
                yield from flatten(f"{name}.{key}", item)
    elif isinstance(value, list):
        for number, item in enumerate(value):
            yield from flatten(f"{name}.{number}", item)


def differences(before: dict[str, float], after: dict[str, float]) -> list[dict[str, Any]]:
    """Rows of all figures that differ by more than 2 %, or that only one side has."""
    rows = []
    for name in sorted(before.keys() | after.keys()):
        old, new = before.get(name), after.get(name)
        if old is None or new is None or abs(new - old) > SAME_SHARE * max(abs(old), abs(new)):
            rows.append({"figure": name, "before": old, "after": new})
    return rows
