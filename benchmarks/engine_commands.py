"""Commands that measure the rasterizer and the training of a scene."""

import json
from pathlib import Path
from typing import Annotated

import typer

from aomgen.cli.run import run_project
from benchmarks.estimate_commands import JsonFile, show, write

engine_app = typer.Typer()


@engine_app.command("splatting")
def splatting(json_file: JsonFile = None) -> None:
    """Time the rasterizer, forward and backward, on a table-top scene, and compare it with float64."""
    from benchmarks.splatting import Effort, default_cases, measure
    from benchmarks.table import as_table

    figures = measure(default_cases(), Effort())
    for name, rows in figures.items():
        shown = as_table(rows) if isinstance(rows, list) else json.dumps(rows, indent=1)
        print(f"\n{name}\n{shown}")
    write(figures, json_file)


@engine_app.command("compare-torch")
def compare_torch(
    gaussians: Annotated[int, typer.Option(min=1, help="Gaussians of the table-top scene.")] = 20_000,
    size: Annotated[tuple[int, int], typer.Option(help="Width and height, [px].")] = (320, 240),
    rounds: Annotated[int, typer.Option(min=1, help="Number of rounds, timed alternately.")] = 5,
    tile: Annotated[int, typer.Option(min=4, help="Side of torch's tiles, [px].")] = 16,
    json_file: JsonFile = None,
) -> None:
    """Time the rasterizer and one in plain torch, on one thread, and compare their images.

    Times are processor time, so that other programs on the machine affect them little.
    """
    from benchmarks.compare_torch import compare
    from benchmarks.scenes import table_camera, table_top

    show(compare(table_top(gaussians, 3), table_camera(*size), rounds, tile), json_file)


@engine_app.command("training")
def training(
    capture: Annotated[Path, typer.Argument(help="A capture; truth/ is not needed.")],
    json_file: JsonFile = None,
    out: Annotated[Path | None, typer.Option(help="Run folder; kept, and continued when it exists.")] = None,
    iterations: Annotated[int, typer.Option(help="Training steps; 0 for the project's own number.")] = 0,
) -> None:
    """Train a capture's scene and print PSNR of the held-out views over the seconds of training."""
    from benchmarks.training import run_training

    show(run_training(capture, out, run_project, iterations=iterations), json_file)
