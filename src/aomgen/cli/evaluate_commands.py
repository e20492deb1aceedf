"""`aomgen evaluate`: the twin as a judge of policies."""

import json
import re
from pathlib import Path
from typing import Annotated, Any

import typer

from aomgen.errors import MissingFileError, UnknownNameError

DEFAULT_COMMAND = "policy"
REAL_OPTION = "--real"


class _PolicyByDefault(typer.core.TyperGroup):
    """`aomgen evaluate SUITE` means `aomgen evaluate policy SUITE`, and `--real FILE` means `real FILE`."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:
        if args and args[0] == REAL_OPTION:
            args = [REAL_OPTION.strip("-"), *args[1:]]
        if args and args[0] not in self.commands and not args[0].startswith("-"):
            args = [DEFAULT_COMMAND, *args]
        return super().parse_args(ctx, args)


evaluate_app = typer.Typer(
    cls=_PolicyByDefault,
    no_args_is_help=True,
    help="Judge policies in the twin: SUITE --policy NAME; beside the real robot: --real trials.csv.",
)
Workers = Annotated[int, typer.Option(min=0, help="Processes; 0 for one a processor.")]


@evaluate_app.command("suite")
def evaluate_suite(
    run: Annotated[Path, typer.Argument(help="Folder of a run that has its assets fitted.")],
    file: Annotated[Path, typer.Argument(help="JSON to write.")],
    trials: Annotated[int, typer.Option(min=1, max=10_000, help="How many.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same trials; not that of the run.")] = 1,
    actions: Annotated[str, typer.Option(help="joint, ee_absolute or ee_delta.")] = "joint",
    size: Annotated[
        str, typer.Option(help="WxH of the images, for example 128x128; as in the run if empty.")
    ] = "",
    cameras: Annotated[list[str] | None, typer.Option("--camera", help="Only these; repeatable.")] = None,
    workers: Workers = 0,
) -> None:
    """Draw trials that every policy shall meet: poses of the run's ranges whose plan passes the certificate."""
    from aomgen.datasets.selection import parse_size
    from aomgen.evaluation.draws import SuiteRequest, make_suite
    from aomgen.evaluation.suite import open_results

    request = SuiteRequest(
        trials=trials,
        seed=seed,
        action_space=_chosen_actions(actions),
        size=parse_size(size) if size else None,
        cameras=tuple(cameras or ()),
    )
    results = open_results(run)
    suite = make_suite(results, file, request, workers or results.workers, _tell)
    nearest = suite.nearest
    apart = f"{nearest.mm:.1f} mm and {nearest.deg:.2f} deg" if nearest else "no episodes yet"
    print(f"{file}: {len(suite.trials)} trials, {sum(suite.redrawn.values())} redrawn {suite.redrawn}")
    print(f"nearest to an episode of the training: {apart}")


@evaluate_app.command(DEFAULT_COMMAND)
def evaluate_policy(
    suite: Annotated[Path, typer.Argument(help="JSON of `aomgen evaluate suite`.")],
    policy: Annotated[
        str,
        typer.Option(
            help="oracle_replay, nearest_replay[=RUN or DATASET], lerobot:DIR, openpi://HOST:PORT or openvla://HOST:PORT[/DATASET]."
        ),
    ],
    actions: Annotated[
        str, typer.Option(help="joint, ee_absolute or ee_delta; as the suite has it if empty.")
    ] = "",
    visuals: Annotated[str, typer.Option(help="splat, or simulator: MuJoCo's renderer.")] = "splat",
    out: Annotated[
        Path | None,
        typer.Option(help="Keeps rollouts and videos of failures; beside the suite if not given."),
    ] = None,
    workers: Workers = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures here.")] = None,
) -> None:
    """Let a policy try every trial of a suite; the same command continues where it was stopped."""
    from aomgen.evaluation.evaluate import EvaluationRequest, evaluate
    from aomgen.evaluation.suite import open_suite
    from aomgen.evaluation.views import VISUALS
    from aomgen.io.atomic import write_json

    if visuals not in VISUALS:
        raise UnknownNameError("--visuals", visuals, VISUALS)
    request = EvaluationRequest(
        policy=policy, action_space=_chosen_actions(actions) if actions else None, visuals=visuals
    )
    words = [suite.stem, re.sub(r"\W+", "-", policy), *filter(None, [actions]), visuals]
    folder = out or suite.with_name("-".join(words))
    opened, results = open_suite(suite)
    figures = evaluate(opened, results, folder, request, workers or results.workers, _tell)
    print(_table(figures))
    if json_file:
        write_json(json_file, figures)


@evaluate_app.command("real")
def evaluate_real(
    trials: Annotated[
        Path, typer.Argument(help="CSV of trials on the real robot: policy, success and, if known, trial.")
    ],
    figures: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Figures of the same policies in the twin (--json); without, those next to the CSV."
        ),
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures here.")] = None,
) -> None:
    """Compare trials on the real robot with the twin: rates, rank violations, and intervals that use both."""
    from aomgen.evaluation.real_trials import (
        compare_with_reality,
        is_evaluation,
        read_real_trials,
        read_twin_trials,
    )
    from aomgen.io.artifact import read_json
    from aomgen.io.atomic import write_json

    real = read_real_trials(trials)
    files = figures or [
        path for path in sorted(trials.parent.glob("*.json")) if is_evaluation(read_json(path))
    ]
    if not files:
        remedy = "give files of `aomgen evaluate SUITE --policy P --json F`"
        raise MissingFileError(trials.parent, "holds no figures of the twin", remedy)
    compared = compare_with_reality(real, read_twin_trials(files), trials)
    print(_real_table(compared))
    if json_file:
        write_json(json_file, compared)


def _real_table(compared: dict[str, Any]) -> str:
    lines = []
    for policy, item in compared["policies"].items():
        lines.append(policy)
        for kind in ("real", "twin"):
            lines.append(
                f"  {kind:12} {_share(item[kind])}, {item[kind]['successes']} of {item[kind]['trials']}"
            )
        combined = item["combined"]
        share = _share({"success_rate": combined["estimate"], "interval_95": combined["interval_95"]})
        saved = (
            f"as {combined['saved_trials']:.0f} more real trials" if item["pairs"] else "no trial is named"
        )
        lines.append(f"  {'real by both':12} {share}, {item['pairs']} pairs, {saved}")
    correlation = compared["pearson_r"]
    count = len(compared["policies"])
    shown = "undefined" if correlation is None else f"{correlation:.3f}"
    lines.append(f"Pearson's r    {shown} over {count} policies")
    lines.append(f"MMRV           {compared['mmrv']:.3f}")
    return "\n".join(lines)


def _share(figures: dict[str, Any]) -> str:
    low, high = figures["interval_95"]
    return f"{figures['success_rate']:.1%} ({low:.1%} to {high:.1%})"


def _table(figures: dict[str, Any]) -> str:
    from aomgen.evaluation.finder_errors import format_errors

    lines = [
        ("policy", f"{figures['policy']}, {figures['action_space']}, {figures['visuals']}"),
        ("success", f"{_share(figures)}, {figures['successes']} of {figures['trials']}"),
        *((f"  {reason}", str(count)) for reason, count in figures["failures"].items()),
        ("redrawn", json.dumps(figures["redrawn"])),
    ]
    text = "\n".join(f"{name:14} {value}" for name, value in lines)
    finder = figures.get("finder_error_mm")
    return f"{text}\n{format_errors(finder, 'error of the finder')}" if finder else text


def _chosen_actions(name: str):
    from aomgen.datasets.features import ACTION_SPACES

    for space in ACTION_SPACES:
        if space == name:
            return space
    raise UnknownNameError("--actions", name, ACTION_SPACES)


def _tell(share: float, text: str) -> None:
    print(f"{share:4.0%} {text}", flush=True)
