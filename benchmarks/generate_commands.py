"""Commands that measure generated assets, episodes, their replay, policies, and runs after faults."""

import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from aomgen.cli.run import run_project, sample_capture
from benchmarks.estimate_commands import JsonFile, show

generate_app = typer.Typer()


@generate_app.command("replay-exported")
def replay_exported(
    outs: Annotated[list[Path], typer.Argument(help="Folders of finished runs.")],
    json_file: JsonFile = None,
) -> None:
    """Replay exported actions in a scene made of the exported USD alone, by category.

    This is repeated with the object 8 cm farther along the gripper's approach,
    where the same actions must fail.
    """
    from benchmarks.replay_exported import run_replay

    show(run_replay(outs), json_file)


@generate_app.command("generate")
def generate(
    out: Annotated[Path, typer.Option(help="Run folder; its twin and fitted assets are kept.")] = Path(
        "out-bench"
    ),
    episodes: Annotated[int, typer.Option(min=2, help="Committed episodes, over two assets.")] = 60,
    workers: Annotated[int, typer.Option(min=0, help="Processes; 0 for one per processor.")] = 0,
    json_file: JsonFile = None,
) -> None:
    """Make verified, rendered and exported demonstrations of the bundled recording; count them per minute.

    Two cameras of 256 x 256, the paper's ranges, full length and rate, rejected attempts included;
    wall clock from the first worker's start to the finished dataset. `core_seconds` and `share` are by
    step, per committed episode.
    """
    from benchmarks.generate import run_generate

    def notify(share: float, text: str) -> None:
        print(f"{share:4.0%} {text}", flush=True)

    machine = {"workers": workers} if workers else {}
    show(run_generate(out, sample_capture(), episodes, run_project, notify, **machine), json_file)


@generate_app.command("environment")
def environment(
    run: Annotated[Path, typer.Argument(help="Folder of a run that has committed episodes.")],
    trials: Annotated[int, typer.Option(min=1, help="Trials of each action space.")] = 100,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    json_file: JsonFile = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of suite and rollouts; continued when it exists.")
    ] = None,
) -> None:
    """Replay plans in closed loop in every action space, compare images, time steps and resets."""
    from benchmarks.environment import run_environment

    with tempfile.TemporaryDirectory() as scratch:
        folder = (out or Path(scratch)).resolve()
        show(run_environment(run, folder, trials, workers, partial(print, file=sys.stderr)), json_file)


@generate_app.command("policy")
def policy(
    out: Annotated[Path, typer.Argument(help="Folder of all results; continued when it exists.")],
    cells: Annotated[
        list[str] | None,
        typer.Option(help="Only tables with this prefix, for example curve.microwave; repeatable."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="A few demonstrations, steps and trials, as a functional test.")
    ] = False,
    assets: Annotated[
        list[str] | None,
        typer.Option("--asset", help="Also tested in unseen_table: a USD file, or FILE#JOINT; repeatable."),
    ] = None,
    workers: Annotated[
        int, typer.Option(min=1, help="Trainings, episodes and rollouts at the same time.")
    ] = 2,
    json_file: JsonFile = None,
) -> None:
    """Train policies on generated demonstrations with LeRobot and count how often they open unseen objects.

    Run it from .venv-policy (`make policy-env`). Hours for all tables; `docs/policies.md` explains the metrics.
    """
    from aomgen.assets.choice import asset_file, open_asset
    from benchmarks.policy import PolicyBench
    from benchmarks.policy_data import PolicyData
    from benchmarks.policy_tables import QUICK, chosen_tables
    from benchmarks.policy_training import QUICK_STEPS, STEPS, Trainer

    named = [str(Path(asset).resolve()) if asset_file(asset) else asset for asset in assets or []]
    for asset in named:
        open_asset(asset)
    data = PolicyData(
        folder=out.resolve(),
        capture=sample_capture(),
        run_project=run_project,
        workers=workers,
        notify=partial(print, file=sys.stderr, flush=True),
        assets=tuple(named),
        **({"trials": 2, "demonstrations": 2} if quick else {}),
    )
    tables = chosen_tables(cells or ([QUICK] if quick else []))
    trainer = Trainer(data=data, steps=QUICK_STEPS if quick else STEPS)
    show(PolicyBench(data=data, trainer=trainer).figures(tables), json_file)


@generate_app.command("replay")
def replay(
    attempts: Annotated[int, typer.Option(help="Plans of each category; a tenth of it beyond.")] = 200,
    seed: Annotated[int, typer.Option(help="Seed of the first motion world and of all draws.")] = 7000,
    json_file: JsonFile = None,
    out: Annotated[Path | None, typer.Option(help="Folder of all results; continued when it exists.")] = None,
) -> None:
    """Plan for generated objects from recovered demonstrations, and replay the exports (the paper's Table 1).

    `docs/episodes.md` explains the metrics.
    """
    from benchmarks.replay_runs import run_replay_bench

    with tempfile.TemporaryDirectory() as scratch:
        folder = (out or Path(scratch)).resolve()
        show(run_replay_bench(folder, attempts, seed, partial(print, flush=True)), json_file)


@generate_app.command("replace")
def replace(
    out: Annotated[
        Path | None, typer.Argument(help="Also score path-traced rooms; folder of these and their results.")
    ] = None,
    rooms: Annotated[list[str] | None, typer.Option("--room", help="Only this room; repeatable.")] = None,
    assets: Annotated[
        list[str] | None, typer.Option("--asset", help="Also a USD file, or FILE#JOINT; repeatable.")
    ] = None,
    meshes: Annotated[bool, typer.Option(help="Render assets as Gaussians and as meshes.")] = True,
    fits: Annotated[bool, typer.Option(help="Scale assets to recovered motions.")] = True,
    seed: Annotated[int, typer.Option(help="Seed of the first generated asset and of all views.")] = 100,
    json_file: JsonFile = None,
) -> None:
    """Render assets as Gaussians and as meshes, fit them to motions, and compare with path-traced images.

    Rooms need Blender (`make blender-env`) and half an hour each. `docs/replacement.md` explains the metrics.
    """
    from aomgen.assets.choice import load_asset
    from benchmarks.replace_fits import run_fits
    from benchmarks.replace_meshes import made_assets, run_meshes
    from benchmarks.replace_scores import ROOMS, run_rooms

    figures: dict = {}
    notify = partial(print, file=sys.stderr, flush=True)
    if meshes:
        figures["mesh"] = run_meshes([*made_assets(seed), *map(load_asset, assets or [])], seed, notify)
    if fits:
        with tempfile.TemporaryDirectory() as scratch:
            figures["fit"] = run_fits((out or Path(scratch)).resolve(), seed, notify)
    if out is not None:
        figures |= run_rooms(out.resolve(), rooms or list(ROOMS), run_project, notify)
    show(figures, json_file)


@generate_app.command("faults")
def faults(
    kills: Annotated[int, typer.Option(min=1, help="Points at which a run is killed.")] = 200,
    json_file: JsonFile = None,
) -> None:
    """Kill runs that make episodes, fill their disk, kill workers, here and on a Ray cluster; continue them.

    Episodes are real but small. `docs/episodes.md` explains the metrics.
    """
    from benchmarks.faults import run_faults

    with tempfile.TemporaryDirectory() as scratch:
        figures = run_faults(Path(scratch), kills, partial(print, file=sys.stderr, flush=True))
    show(figures, json_file)


@generate_app.command("scale")
def scale(
    folder: Annotated[
        Path, typer.Argument(help="Folder of the runs; it must not exist, and is deleted afterwards.")
    ],
    units: Annotated[int, typer.Option(min=10_000, help="Committed episodes of the largest run.")] = 100_000,
    json_file: JsonFile = None,
) -> None:
    """Measure status, continuation and completion of runs with many episodes, and their export in shards.

    The episodes are links to one small episode. `docs/episodes.md` explains the metrics.
    """
    from benchmarks.scale import run_scale
    from benchmarks.table import as_table

    rows = run_scale(folder.resolve(), units, partial(print, file=sys.stderr, flush=True))
    show({"scale": rows}, json_file)
    print(as_table(rows))


@generate_app.command("scan-walks")
def scan_walks(
    run: Annotated[Path, typer.Argument(help="Folder of a run that is finished up to its alignment.")],
    folder: Annotated[Path, typer.Argument(help="Folder of the JPEGs.")],
) -> None:
    """Render a good walk of a scan around the scene of a run, and three bad ones."""
    from benchmarks.scan_walks import draw_walks

    for path in draw_walks(run, folder):
        print(path)


@generate_app.command("style-pictures")
def style_pictures(file: Annotated[Path, typer.Argument(help="JPEG to write.")]) -> None:
    """Render all styles of generated assets into one image, one row per category."""
    from benchmarks.style_pictures import draw_styles

    draw_styles(file)
