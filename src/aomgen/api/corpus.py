"""Run of every capture of a folder: one unit of work for each capture, and one table of results.

`OUT/<capture>` is the run of a capture, and `OUT/corpus.json` lists the result of each of them. The same call continues: runs
that are up to date are kept, and captures that failed are tried again.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from aomgen.api.run import bring_up_to_date
from aomgen.capture.read import read_capture
from aomgen.core.recording import CAPTURE_FILE
from aomgen.errors import AomgenError, MissingFileError
from aomgen.executors import LOST, Executor, Work, try_units
from aomgen.io.atomic import write_json
from aomgen.pipeline.manifest import MANIFEST, read_manifest
from aomgen.pipeline.preflight import new_project
from aomgen.pipeline.stages import STAGES

CORPUS_FILE: Final = "corpus.json"
# A capture that takes longer is given up, [s]: hours are usual for a large scan on one core, a day is not.
CAPTURE_S: Final = 24 * 3600.0
# Metrics in the table of results, by column: stage and name.
COLUMNS: Final = {
    "psnr_db": ("gaussians", "heldout_psnr"),
    "joint": ("motion", "joint"),
    "axis_ci95_deg": ("motion", "axis_ci95_deg"),
    "episodes": ("episodes", "episodes"),
}
WAITING, DONE, FAILED = "waiting", "done", "failed"


def run_corpus(
    captures: Path, out: Path, executor: Executor, on_done: Callable[[str, dict[str, Any]], None]
) -> dict[str, dict[str, Any]]:
    """Run every capture of a folder and write the table of results after each of them.

    Args:
        captures: Folder whose subfolders are captures.
        out: Folder of the runs and of the table.
        executor: Its work runs the capture of a name and returns the message of its error, if any; see `open_corpus`.
        on_done: Receives name and row of each capture that has ended.

    Returns:
        One row for each capture by name: its state "done" or "failed", its error, and the last finished stage; if it did
        not fail, also the number of its warnings and the metrics of `COLUMNS`.

    Raises:
        MissingFileError: The folder has no capture.
        StorageError: The table cannot be written.
    """
    names = list_captures(captures)
    rows: dict[str, dict[str, Any]] = {name: {"state": WAITING} for name in names}
    write_json(out / CORPUS_FILE, {"captures": rows})
    for done in try_units(names, executor):
        error = LOST[done.lost] if done.lost else done.value
        rows[done.unit] = _describe(out / done.unit, error)
        write_json(out / CORPUS_FILE, {"captures": rows})
        on_done(done.unit, rows[done.unit])
    return rows


def list_captures(folder: Path) -> list[str]:
    """List the names of the captures in a folder.

    Raises:
        MissingFileError: There is none.
    """
    names = sorted(path.parent.name for path in folder.glob(f"*/{CAPTURE_FILE}"))
    if not names:
        raise MissingFileError(
            folder, "has no capture", f"give a folder whose subfolders contain {CAPTURE_FILE}"
        )
    return names


def open_corpus(captures: Path, out: Path, until: str, assets: Sequence[str]) -> Work:
    """Open a worker function that runs the capture of a name; the arguments are those of `run_corpus` and `reconstruct`."""
    return partial(_run_capture, captures, out, until, assets)


def _run_capture(captures: Path, out: Path, until: str, assets: Sequence[str], name: str) -> str:
    """Run a capture with one process, and return the message of its error, if any."""
    try:
        with warnings.catch_warnings():
            # The manifests and the report of the run contain the warnings about a capture.
            warnings.simplefilter("ignore", UserWarning)
            project = new_project(read_capture(captures / name), out / name, assets)
            bring_up_to_date(project, until=until, progress=False, workers=1)
    except AomgenError as error:
        return str(error)
    return ""


def _describe(run: Path, error: str) -> dict[str, Any]:
    """Make the row of a capture. A failed run has no metrics, because its manifests may be the damaged files."""
    finished = [stage for stage in STAGES if (run / stage.folder / MANIFEST).is_file()]
    row = {"state": FAILED if error else DONE, "error": error, "stage": finished[-1].name if finished else ""}
    if error:
        return row
    found = {stage.name: read_manifest(run / stage.folder) for stage in finished}
    manifests = {name: manifest for name, manifest in found.items() if manifest is not None}
    figures = {
        column: manifests[stage].figures.get(name)
        for column, (stage, name) in COLUMNS.items()
        if stage in manifests
    }
    return row | {"warnings": sum(len(item.warnings) for item in manifests.values()), **figures}
