"""Commands that measure estimates and the twin."""

import json
from pathlib import Path
from typing import Annotated

import typer

from aomgen.cli.run import run_project
from aomgen.errors import ConfigError

JsonFile = Annotated[Path | None, typer.Option("--json", help="Write the metrics here.")]
estimate_app = typer.Typer()


@estimate_app.command("accuracy")
def accuracy(
    capture: Annotated[Path | None, typer.Argument(help="A capture with truth/.")] = None,
    synthetic: Annotated[int, typer.Option(help="Instead: make and score this many synthetic captures.")] = 0,
    synthetic_motion: Annotated[
        int, typer.Option(help="Instead: this many cheap worlds for AOMotion alone.")
    ] = 0,
    category: Annotated[
        str | None,
        typer.Option(help="Only such synthetic captures: cabinet, drawer, laptop, microwave or toolbox."),
    ] = None,
    harsh: Annotated[
        bool, typer.Option("--harsh", help="Degrade synthetic captures as phones and labs do.")
    ] = False,
    seed: Annotated[int | None, typer.Option(help="First seed: 1000, for motion worlds 2000.")] = None,
    saga: Annotated[bool, typer.Option("--saga", help="Also score parts from affinity features.")] = False,
    paper: Annotated[bool, typer.Option("--paper", help="Also score the paper's own methods.")] = False,
    json_file: JsonFile = None,
    out: Annotated[Path | None, typer.Option(help="Run folder; kept, and continued when it exists.")] = None,
) -> None:
    """Run a capture up to its twin and score estimates and renders against its ground truth.

    With --synthetic N, N captures of different objects, rooms, cameras and noise are made, run and scored
    one after the other (about four minutes each): median and worst of every metric; categories alternate
    unless --category names one. With --synthetic-motion N, N demonstrations are simulated and rendered to
    video, upstream results perturbed by measured errors, and the motion alone recovered (half a minute each;
    --out keeps the worlds).
    """
    if category is not None and synthetic == 0:
        raise ConfigError("--category", "holds for --synthetic N alone", "add --synthetic or leave it out")
    if synthetic_motion:
        _measure_motion(synthetic_motion, seed, out, json_file)
        return
    from benchmarks.alignment_methods import methods_table
    from benchmarks.capture_accuracy import run_accuracy
    from benchmarks.motion_methods import motion_methods_table
    from benchmarks.synthetic_captures import FIRST_SEED, accuracy_table, run_synthetic, synthetic_table

    if (capture is None) == (synthetic == 0):
        raise ConfigError("accuracy", "wants a capture or --synthetic N", "give one of the two")
    if capture is None:
        first = FIRST_SEED if seed is None else seed
        results = run_synthetic(synthetic, out, run_project, first, category=category, harsh=harsh)
        table = synthetic_table(results)
    else:
        results = run_accuracy(capture, out, run_project, saga=saga, paper=paper)
        table = accuracy_table(results)
    show(results, json_file)
    print(table)
    if paper:
        print(f"\n{methods_table(results)}\n\n{motion_methods_table(results)}")


@estimate_app.command("scores")
def scores(
    folder: Annotated[Path, typer.Argument(help="Runs and metrics; existing ones are kept.")],
    capture: Annotated[
        list[Path] | None, typer.Option(help="A capture with truth/; may be repeated.")
    ] = None,
    part: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this part: captures, synthetic, motion, intervals, replace, generate, replay or "
            "splatting; may be repeated."
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="First seed of generated captures and worlds; 77000.")
    ] = None,
    against: Annotated[Path | None, typer.Option(help="An earlier scores.json to compare with.")] = None,
) -> None:
    """Run all benchmarks that evaluate a change (hours); gather their metrics in FOLDER/scores.json.

    With --against, print a verdict for each metric: images within 0.2 dB, errors, times and rates
    within 5 %, success rates within the 95 % interval (Wilson's) of those before. The exit code is 1 if
    one is worse or missing.
    """
    from aomgen.io.artifact import read_json
    from benchmarks.score_tolerances import as_rows, judge
    from benchmarks.scores import PARTS, UNUSED_SEED, part_of, run_scores
    from benchmarks.table import as_table

    parts = part or PARTS
    before = None if against is None else read_json(against)
    figures = run_scores(folder, capture or [], parts, UNUSED_SEED if seed is None else seed, print)
    if before is not None:
        judged = judge({name: before[name] for name in before if part_of(name) in parts}, figures)
        print(as_table(as_rows(judged)))
        if not all(row.passes for row in judged):
            raise typer.Exit(1)


@estimate_app.command("alignment")
def alignment(
    paths: Annotated[list[Path], typer.Argument(help="Captures with truth/, or finished runs of such.")],
    starts: Annotated[int, typer.Option(help="Good and bad starts, over all paths; about 10 s each.")] = 200,
    seed: Annotated[int, typer.Option(help="Equal seeds give equal starts.")] = 0,
    json_file: JsonFile = None,
) -> None:
    """Disturb frames, prompts, cameras and joint values: measure accuracy and refusals of the alignment.

    Six of ten starts have a solution; in the others the robot is missing, has another pose than the
    prompts, has other joint values than the log, or is mirrored.
    """
    from benchmarks.alignment import run_alignment_bench

    def notify(row: dict) -> None:
        print("  ".join(f"{value:.3g}" if isinstance(value, float) else str(value) for value in row.values()))

    figures = run_alignment_bench(paths, starts, seed, run_project, notify)
    show({name: value for name, value in figures.items() if name != "rows"}, None)
    write(figures, json_file)


@estimate_app.command("imports")
def imports(
    capture: Annotated[Path, typer.Argument(help="A capture with truth/.")],
    folder: Annotated[Path, typer.Argument(help="Keeps captures and runs; continued when it exists.")],
    json_file: JsonFile = None,
) -> None:
    """Write a capture in other formats, import each, and run it up to its motion.

    Errors against the truth: those of the capture itself, and of every format those minus them.
    """
    from benchmarks.imports import run_imports
    from benchmarks.table import as_table

    rows = run_imports(capture, folder, run_project, lambda text: print(text, flush=True))
    print(as_table(rows))
    write({"imports": rows}, json_file)


@estimate_app.command("intervals")
def intervals(
    worlds: Annotated[int, typer.Option(help="Hidden joints; half a second each.")] = 200,
    seed: Annotated[int, typer.Option(help="First seed.")] = 5000,
    json_file: JsonFile = None,
) -> None:
    """Test the stated 95 % intervals on hidden joints behind end effector paths that slip and pivot.

    `held` is the share of intervals that hold the truth, `width` their median over the median error.
    """
    from benchmarks.joint_intervals import interval_figures, measure_world
    from benchmarks.table import as_table

    figures = interval_figures([measure_world(seed + number) for number in range(worlds)])
    print(as_table(figures))
    write({"intervals": figures}, json_file)


def _measure_motion(count: int, seed: int | None, out: Path | None, json_file: Path | None) -> None:
    from benchmarks.motion_accuracy import FIRST_SEED, cases, run_motion
    from benchmarks.motion_table import fractions_of, motion_table, summaries_of, told, unsolvable_of
    from benchmarks.table import as_table

    wanted = cases(count, FIRST_SEED if seed is None else seed)
    outcomes = run_motion(
        wanted,
        out,
        lambda outcome: print(told(outcome), flush=True),
        lambda case, why: print(f"{case.category}-{case.seed} {case.kind} left out: {why}", flush=True),
    )
    summaries = summaries_of(outcomes)
    unsolvable, fractions = unsolvable_of(outcomes), fractions_of(outcomes)
    print(f"\n{motion_table(summaries)}\n\n{as_table(unsolvable)}\n\n{as_table(fractions)}")
    rows = [outcome.row() for outcome in outcomes]
    figures = {"summaries": summaries, "unsolvable": unsolvable, "fractions": fractions, "worlds": rows}
    write(figures, json_file)


def show(figures: dict, json_file: Path | None) -> None:
    """Print metrics as JSON, and write them where a file is given."""
    print(json.dumps(figures, indent=1))
    write(figures, json_file)


def write(figures: dict, json_file: Path | None) -> None:
    """Write metrics where a file is given."""
    from aomgen.io.atomic import write_json

    if json_file:
        write_json(json_file, figures)
