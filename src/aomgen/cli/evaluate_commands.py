"""`aomgen evaluate`: evaluation of policies in the twin, and comparison with trials on the real robot."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from aomgen.errors import MissingFileError, UnknownNameError

DEFAULT_COMMAND = "policy"
REAL_OPTION = "--real"


def _split_real(arg: str) -> list[str]:
    """Split `--real=FILE` into option and value."""
    return arg.split("=", 1) if arg.startswith(f"{REAL_OPTION}=") else [arg]


class _PolicyByDefault(typer.core.TyperGroup):
    """`aomgen evaluate SUITE` means `aomgen evaluate policy SUITE`, and `--real FILE` means `real FILE`."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:
        if not args or args[0] in self.commands:
            return super().parse_args(ctx, args)
        words = [word for arg in args for word in _split_real(arg)]
        if REAL_OPTION in words:
            # The file after the option precedes all others.
            at = words.index(REAL_OPTION)
            args = [REAL_OPTION.strip("-"), *words[at + 1 :], *words[:at]]
        elif any(not arg.startswith("-") for arg in args):
            args = [DEFAULT_COMMAND, *args]
        return super().parse_args(ctx, args)


evaluate_app = typer.Typer(
    cls=_PolicyByDefault,
    no_args_is_help=True,
    help="Evaluate policies in the twin, or compare with the real robot.\n\n"
    "`aomgen evaluate SUITE --policy NAME` evaluates a policy; `aomgen evaluate --real trials.csv` compares.",
)
Workers = Annotated[int, typer.Option(min=0, help="Number of processes; 0 means one for each CPU core.")]


@evaluate_app.command("suite")
def evaluate_suite(
    run: Annotated[Path, typer.Argument(help="Folder of a run whose stage 'replacement' is done.")],
    file: Annotated[Path, typer.Argument(help="JSON file to write.")],
    trials: Annotated[int, typer.Option(min=1, max=10_000, help="Number of trials.")] = 200,
    seed: Annotated[
        int, typer.Option(min=0, help="Random seed of the trials; it has to differ from the seed of the run.")
    ] = 1,
    actions: Annotated[str, typer.Option(help="Action space: joint, ee_absolute or ee_delta.")] = "joint",
    size: Annotated[
        str, typer.Option(help="Image size WxH, for example 128x128. Default: the size in the run.")
    ] = "",
    cameras: Annotated[
        list[str] | None,
        typer.Option("--camera", help="Camera to use (default: all of the run); repeatable."),
    ] = None,
    workers: Workers = 0,
) -> None:
    """Sample the trials on which policies are evaluated.

    Each trial has an object pose from the ranges of the run for which a verified plan exists.
    """
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
    apart = f"{nearest.mm:.1f} mm and {nearest.deg:.2f} deg" if nearest else "the run has no episodes"
    print(f"{file}: {len(suite.trials)} trials, skipped samples: {_list_counts(suite.redrawn)}")
    print(f"smallest distance of a trial to an episode of the run: {apart}")


@evaluate_app.command(DEFAULT_COMMAND)
def evaluate_policy(
    suite: Annotated[Path, typer.Argument(help="File that `aomgen evaluate suite` wrote.")],
    policy: Annotated[
        str,
        typer.Option(
            help="Policy: oracle_replay, nearest_replay[=RUN or DATASET], lerobot:DIR, openpi://HOST:PORT or "
            "openvla://HOST:PORT[/DATASET]."
        ),
    ],
    actions: Annotated[
        str, typer.Option(help="Action space: joint, ee_absolute or ee_delta. Default: that of the suite.")
    ] = "",
    visuals: Annotated[
        str, typer.Option(help="Renderer of the images: splat (Gaussians) or simulator (MuJoCo).")
    ] = "splat",
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for rollouts and videos of failures. Default: a folder next to the suite."),
    ] = None,
    workers: Workers = 0,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="JSON file to write the metrics to.")
    ] = None,
) -> None:
    """Evaluate a policy in every trial of a suite.

    After an interruption the same command continues.
    """
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
        Path,
        typer.Argument(
            help="CSV file of the trials on the real robot, with columns policy, success and, optionally, trial."
        ),
    ],
    figures: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Files that `aomgen evaluate --json` wrote for the same policies. Default: those next to the CSV file."
        ),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="JSON file to write the metrics to.")
    ] = None,
) -> None:
    """Compare trials on the real robot with trials in the twin.

    The command reports success rates, rank violations, and confidence intervals that use both kinds of trials.
    """
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
        raise MissingFileError(trials.parent, "contains no results of `aomgen evaluate`", remedy)
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


def _list_counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in counts.items()) or "none"


def _table(figures: dict[str, Any]) -> str:
    from aomgen.evaluation.finder_errors import format_errors

    lines = [
        ("policy", f"{figures['policy']}, {figures['action_space']}, {figures['visuals']}"),
        ("success", f"{_share(figures)}, {figures['successes']} of {figures['trials']}"),
        *((f"  {reason}", str(count)) for reason, count in figures["failures"].items()),
        ("touched", f"an obstacle in {figures['touched_obstacle']} trials"),
        ("skipped", _list_counts(figures["redrawn"])),
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
