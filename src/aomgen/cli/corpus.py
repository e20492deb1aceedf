"""`aomgen corpus`: run every capture of a folder and print one table of results."""

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from aomgen.errors import AomgenError


def corpus(
    captures: Annotated[Path, typer.Argument(help="Folder whose subfolders are captures.")],
    out: Annotated[Path, typer.Argument(help="Folder for the runs, one subfolder for each capture.")],
    until: Annotated[str, typer.Option(help="Stop each run after this stage. Default: all stages.")] = "",
    assets: Annotated[
        list[str] | None,
        typer.Option(
            "--asset",
            help="Asset of every run: category:seed, a USD file, or 'original'; repeatable. Default: two generated assets of the "
            "capture's category.",
        ),
    ] = None,
    workers: Annotated[
        int, typer.Option(min=0, help="Number of captures at the same time; 0 means one for each CPU core.")
    ] = 0,
    ray: Annotated[
        str,
        typer.Option(
            help="Run the captures on a Ray cluster (auto or HOST:PORT) that can access both folders."
        ),
    ] = "",
) -> None:
    """Run every capture of a folder.

    Each run uses one CPU core and the default settings. The results are printed as a table and stored in OUT/corpus.json. A
    capture that fails does not stop the others; its error is listed, and the exit code is 1. The same command continues an
    interrupted corpus: results that are up to date are kept, and captures that failed are tried again.
    """
    from aomgen.api.arguments import require_name
    from aomgen.api.corpus import CAPTURE_S, CORPUS_FILE, FAILED, list_captures, open_corpus, run_corpus
    from aomgen.assets.choice import resolve_asset
    from aomgen.executors import Processes
    from aomgen.pipeline.stages import STAGES
    from aomgen.ray_cluster import RayCluster

    if until:
        require_name("--until", until, [stage.name for stage in STAGES])
    captures, out = captures.resolve(), out.resolve()
    names = list_captures(captures)
    given = tuple(map(resolve_asset, assets or ()))
    opener = partial(open_corpus, captures, out, until, given)
    slots = min(workers or len(os.sched_getaffinity(0)), len(names))
    executor = RayCluster(opener, ray, CAPTURE_S) if ray else Processes(opener, slots, CAPTURE_S)
    rows = run_corpus(captures, out, executor, lambda name, row: print(_line(name, row), flush=True))
    print(_format_table(rows))
    failed = sum(row["state"] == FAILED for row in rows.values())
    if failed:
        raise AomgenError(
            out / CORPUS_FILE,
            f"lists {failed} of {len(rows)} captures that failed",
            "correct these captures and run the same command again",
        )


def _line(name: str, row: Mapping[str, Any]) -> str:
    return f"  {row['state']:7} {name}" + (f": {row['error']}" if row["error"] else "")


def _format_table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Format the results as aligned columns."""
    from aomgen.api.corpus import COLUMNS

    names = ("state", "stage", "warnings", *COLUMNS)
    cells = [["capture", *names]]
    cells += [[name, *(_cell(row.get(key)) for key in names)] for name, row in sorted(rows.items())]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in cells
    )


def _cell(value: Any) -> str:
    if value in (None, ""):
        return "-"
    return f"{value:.2f}" if isinstance(value, float) else str(value)
