"""`python -m benchmarks accuracy --synthetic N`: unseen captures, end to end, in one table."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.assets.choice import MAKERS
from aomgen.errors import ConfigError, EstimationError
from aomgen.io.artifact import read_json
from aomgen.io.atomic import write_json
from benchmarks.bars import BARS
from benchmarks.capture_accuracy import run_accuracy
from benchmarks.harsh_capture import degrade_capture
from benchmarks.table import as_table
from synthetic.scene_recording import Conditions
from synthetic.world import make_capture

# Seeds below are for inspection during development; a score requires unseen ones.
FIRST_SEED: Final = 1000
RESULT = "figures.json"
REFUSED = "refused_because"


def run_synthetic(
    count: int,
    out: Path | None,
    run_project: Callable[..., None],
    first_seed: int = FIRST_SEED,
    *,
    category: str | None = None,
    harsh: bool = False,
) -> dict[str, Any]:
    """Make captures of different objects, rooms, cameras and noise; run and score each.

    Args:
        count: Number of captures.
        out: Folder of captures, runs and metrics, continued when it exists; temporary when None.
        run_project: Runs a project up to a stage.
        first_seed: Seed of the first capture, the others follow.
        category: Category of all of them; None: categories alternate.
        harsh: Degrade each, as phones and labs do (see `harsh_capture`).

    Returns:
        `captures` (metrics by capture), and `median`, `worst` and `refusals` by metric. A capture
        that a stage refused has no metrics and counts as refused in every one.

    Raises:
        ConfigError: The category is unknown.
    """
    categories = sorted(MAKERS) if category is None else [category]
    if category is not None and category not in MAKERS:
        raise ConfigError("--category", f"{category!r} is unknown", f"choose one of {', '.join(MAKERS)}")
    with tempfile.TemporaryDirectory() as scratch:
        root = (out or Path(scratch)).resolve()
        captures = {}
        for number in range(count):
            kind, seed = categories[number % len(categories)], first_seed + number
            name = f"{kind}-{seed}{'-harsh' if harsh else ''}"
            captures[name] = _one(root / name, kind, seed, run_project, harsh=harsh)
    return {"captures": captures} | summary(captures)


def _one(
    folder: Path, category: str, seed: int, run_project: Callable[..., None], *, harsh: bool
) -> dict[str, Any]:
    result = folder / RESULT
    if result.is_file():
        return read_json(result)
    capture = folder / "capture"
    clean = folder / "clean" if harsh else capture
    if not clean.is_dir():
        conditions = draw_conditions(np.random.default_rng(seed))
        make_capture(clean, category=category, seed=seed, conditions=conditions)
    if not capture.is_dir():
        degrade_capture(clean, capture, np.random.default_rng([seed, 1]))
    try:
        figures = run_accuracy(capture, folder / "run", run_project)
    except EstimationError as error:
        figures = {REFUSED: str(error)}
    write_json(result, figures)
    return figures


def summary(captures: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Compute median and worst of every metric with a threshold, and how many captures gave none.

    A refusal ranks worst, so that it moves the median too; where the median
    or the worst falls on a refusal it is None.
    """
    median, worst, refusals = {}, {}, {}
    for name, bar in BARS.items():
        values = [figures.get(name) for figures in captures.values()]
        missing = float("inf") if bar.at_most else float("-inf")
        filled = sorted(
            (missing if value is None else float(value) for value in values), reverse=not bar.at_most
        )
        refusals[name] = sum(value is None for value in values)
        median[name] = _finite(float(np.median(filled))) if filled else None
        worst[name] = _finite(filled[-1]) if filled else None
    return {"median": median, "worst": worst, "refusals": refusals}


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def synthetic_table(results: dict[str, Any]) -> str:
    """Format one row per metric: threshold, median, worst, then every capture."""
    rows = [
        {
            "figure": name,
            "wanted": str(bar),
            "median": results["median"][name],
            "worst": results["worst"][name],
        }
        | {capture: figures.get(name) for capture, figures in results["captures"].items()}
        for name, bar in BARS.items()
    ]
    reasons = {
        capture: figures[REFUSED] for capture, figures in results["captures"].items() if REFUSED in figures
    }
    return as_table(rows) + (f"\n{json.dumps(reasons, indent=1)}" if reasons else "")


def accuracy_table(figures: dict[str, Any]) -> str:
    """Format one row per metric of a single capture, with its threshold."""
    return as_table(
        [
            {
                "figure": name,
                "wanted": str(bar),
                "measured": figures.get(name),
                "met": bar.met(figures.get(name)),
            }
            for name, bar in BARS.items()
        ]
    )


def draw_conditions(rng: np.random.Generator) -> Conditions:
    """Draw recording conditions: lens, image size, light, length of the walk."""
    return Conditions(
        size=((320, 240), (400, 300), (384, 256))[rng.integers(3)],
        scan_views=int(rng.integers(40, 57)),
        fps=int(rng.choice([10, 12, 15])),
        focal_share=rng.uniform(0.8, 1.0),
        noise=rng.uniform(0.6, 2.0),
        gain_spread=rng.uniform(0.01, 0.06),
    )
