"""All benchmarks that evaluate a change, run as commands, and their metrics in one file.

Each part writes one JSON to the folder; a second call runs the missing ones.
"""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from aomgen.errors import ConfigError, suggest
from aomgen.io.atomic import write_json
from benchmarks.path_tracer import blender_python
from benchmarks.replace_rooms import ROOMS

SCORES_FILE = "scores.json"
# First seed of captures and worlds: no constant was chosen on it or its successors.
UNUSED_SEED: Final = 77_000
# One synthetic capture of each category; enough worlds, episodes and attempts that one
# outlier moves no median.
SYNTHETIC, MOTION_WORLDS, JOINT_WORLDS, EPISODES, ATTEMPTS, ROOM_COUNT = 5, 30, 200, 60, 50, 3
PARTS: Final = ("captures", "synthetic", "motion", "intervals", "replace", "generate", "replay", "splatting")
# Lists and tables in addition to the metrics: every single world, capture, asset or room.
DETAILS: Final = {"worlds", "rows", "captures", "rooms", "categories", "assets"}


def run_scores(
    folder: Path, captures: Sequence[Path], parts: Sequence[str], seed: int, notify: Callable[[str], None]
) -> dict[str, float]:
    """Run every part that is missing in the folder, and write all metrics to `scores.json`.

    Args:
        folder: Runs, and one JSON per part.
        captures: Captures with ground truth; the part `captures` runs each of them.
        parts: Names from `PARTS`.
        seed: First seed of made captures and worlds.
        notify: Receives a line on each part.

    Returns:
        Metrics by dotted name.

    Raises:
        ConfigError: A part is unknown or failed; the output of a failed one has been shown.
    """
    for part in parts:
        if part not in PARTS:
            raise ConfigError("--part", f"{part!r} is unknown", suggest(part, PARTS))
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if "replace" in parts and not blender_python().is_file():
        notify("replace: without path-traced rooms, as Blender is not installed (`make blender-env`)")
    commands = _commands(folder, captures, seed)
    chosen = {name: commands[name] for name in commands if part_of(name) in parts}
    for name, arguments in chosen.items():
        result = folder / f"{name}.json"
        if result.is_file():
            notify(f"{name}: kept")
            continue
        arguments = [*arguments, "--json", str(result)]
        notify(f"{name}: python -m benchmarks {' '.join(arguments)}")
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks", *arguments], cwd=Path(__file__).parents[1], check=False
        )
        if done.returncode != 0:
            problem = f"ended with exit code {done.returncode}"
            raise ConfigError(f"part '{name}' of the scores", problem, "see above, and rerun")
    figures = {
        figure: value
        for name in chosen
        for figure, value in flatten(name, json.loads((folder / f"{name}.json").read_text("utf-8")))
    }
    write_json(folder / SCORES_FILE, figures)
    return figures


def part_of(name: str) -> str:
    """Return the part of a command or a metric."""
    first = name.split(".")[0]
    return first if first in PARTS else "captures"


def _commands(folder: Path, captures: Sequence[Path], seed: int) -> dict[str, list[str]]:
    """Return arguments of each part's command, by name; a capture's name is `capture-` and its folder's."""
    seeded = ["--seed", str(seed)]

    def out(name: str) -> list[str]:
        return ["--out", str(folder / name)]

    commands = {}
    for path in captures:
        name = f"capture-{path.resolve().name}"
        commands[name] = ["accuracy", str(path.resolve()), *out(name)]
    synthetic = ["accuracy", "--synthetic", str(SYNTHETIC), *seeded, *out("synthetic")]
    motion = ["accuracy", "--synthetic-motion", str(MOTION_WORLDS), *seeded, *out("motion")]
    rooms = [word for room in list(ROOMS)[:ROOM_COUNT] for word in ("--room", room)]
    traced = [str(folder / "replace"), *rooms] if blender_python().is_file() else []
    return commands | {
        "synthetic": synthetic,
        "motion": motion,
        "intervals": ["intervals", "--worlds", str(JOINT_WORLDS), *seeded],
        "replace": ["replace", *traced, *seeded],
        "generate": ["generate", "--episodes", str(EPISODES), *out("generate")],
        "replay": ["replay", "--attempts", str(ATTEMPTS), *seeded, *out("replay")],
        "splatting": ["splatting"],
    }


def flatten(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield numbers of nested JSON under dotted names."""
    if isinstance(value, int | float):
        yield name, float(value)
    elif isinstance(value, dict):
        for key, item in value.items():
            if key not in DETAILS or isinstance(item, int | float):
                yield from flatten(f"{name}.{key}", item)
    elif isinstance(value, list):
        for number, item in enumerate(value):
            yield from flatten(f"{name}.{number}", item)
