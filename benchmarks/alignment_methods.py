"""Stages of a finished run recomputed by other methods: the paper's rigid ICP and link boxes, affinity features."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from aomgen.appearance.stage import bind_scan
from aomgen.core.progress import silent
from aomgen.paper.methods import run_alignment, run_parts
from aomgen.parts.label import MotionEvidence
from aomgen.results import Results
from aomgen.twin.twin import TwinModel
from benchmarks.table import as_table

PREFIX = "paper."
# Metrics in which the two methods are compared.
GROUPS = ("alignment.", "cameras.median", "demo_camera.", "parts.", "images.replay")


def with_paper_alignment(results: Results, folder: Path) -> tuple[Results, float]:
    """Align a run by the paper's method in a separate folder; also returns the seconds that it took.

    Raises:
        AlignmentError: The method refuses.
    """
    folder.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    run_alignment(results, folder, silent)
    seconds = time.monotonic() - started
    project = results.project.model_copy(update={"alignment_method": "paper"})
    return replace(results, project=project, folders={**results.folders, "alignment": folder}), seconds


def with_parts(results: Results, folder: Path, evidence: MotionEvidence) -> tuple[Results, float]:
    """Find the parts of a run again in a separate folder; also returns the seconds that it took.

    Raises:
        ReconstructionError: The method refuses.
    """
    folder.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    run_parts(results, folder, silent, evidence)
    seconds = time.monotonic() - started
    return replace(results, folders={**results.folders, "parts": folder}), seconds


def bound_twin(results: Results) -> TwinModel:
    """Bind the scan of a run to its bodies, without refinement."""
    return bind_scan(results.scene, results.parts, results.motion.joint, results.configuration)


def paper_figures(scored: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Select the comparable metrics of a twin, under separate names."""
    kept = {name: value for name, value in scored.items() if name.startswith(GROUPS)}
    return {PREFIX + name: value for name, value in kept.items()} | {f"{PREFIX}seconds": round(seconds, 1)}


def methods_table(figures: dict[str, Any]) -> str:
    """Format one row for each metric of both methods."""
    names = [name.removeprefix(PREFIX) for name in figures if name.startswith(PREFIX)]
    return as_table(
        [
            {"figure": name, "outlines": figures[name], "paper": figures[PREFIX + name]}
            for name in names
            if isinstance(figures.get(name), float | int | None) and name in figures
        ]
    )
