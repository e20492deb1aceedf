"""Comparison of trials of policies on the real robot with trials in the twin."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from aomgen.errors import (
    ConfigError,
    LimitExceededError,
    MalformedFileError,
    MissingFileError,
    UnknownNameError,
)
from aomgen.evaluation.evaluate import interval_95
from aomgen.evaluation.prediction_powered import (
    correlate,
    estimate_real_success,
    mean_maximum_rank_violation,
)
from aomgen.io.artifact import read_json

COLUMNS: Final = ("policy", "success")
TRIAL: Final = "trial"
WORDS: Final = {
    **dict.fromkeys(("1", "true", "yes", "success"), 1),
    **dict.fromkeys(("0", "false", "no", "failure"), 0),
}
# Largest file of real trials, [bytes].
MAX_BYTES: Final = 4 << 20
# Keys that are read from the results of `aomgen evaluate`.
FIGURES: Final = ("policy", "suite", "rollouts")


def read_real_trials(path: Path) -> dict[str, tuple[list[int], list[int]]]:
    """Read a CSV with the columns policy, success and, optionally, trial.

    Success is 1 or 0, true or false, yes or no. A trial is the number of the suite's trial that was reproduced in
    reality.

    Returns:
        Results, 0 or 1, and numbers of the trials (empty if unknown), by policy.

    Raises:
        MissingFileError, LimitExceededError: The file is missing or too large.
        MalformedFileError: A column is missing, or a row is invalid; the error names it.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "give a CSV with the columns policy, success and trial")
    if not path.stat().st_size <= MAX_BYTES:
        raise LimitExceededError(path, f"is larger than {MAX_BYTES} bytes")
    try:
        rows = list(csv.DictReader(path.read_text("utf-8-sig").splitlines(), skipinitialspace=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise MalformedFileError(path, f"is not a CSV file ({error})", "save it as CSV in UTF-8") from error
    missing = [name for name in COLUMNS if not rows or name not in rows[0]]
    if missing:
        raise MalformedFileError(path, f"has no rows with the column {missing[0]}", "add it")
    found: dict[str, list[tuple[int, int | None]]] = {}
    for number, row in enumerate(rows, start=2):
        policy, word, trial = ((row.get(name) or "").strip() for name in (*COLUMNS, TRIAL))
        if not policy or word.lower() not in WORDS or not (trial.isdecimal() or not trial):
            problem = f"row {number} has policy '{policy}', success '{word}', trial '{trial}'"
            raise MalformedFileError(
                path, problem, "expected a name, 1 or 0, and a number of the suite or nothing"
            )
        found.setdefault(policy, []).append((WORDS[word.lower()], int(trial) if trial else None))
    return {
        policy: ([result for result, _ in items], _check_trials(path, policy, [trial for _, trial in items]))
        for policy, items in found.items()
    }


def _check_trials(path: Path, policy: str, stated: list[int | None]) -> list[int]:
    """Return the numbers of a policy's trials, which are stated in all rows or in none, and differ."""
    trials = [trial for trial in stated if trial is not None]
    if trials and len(trials) < len(stated):
        raise MalformedFileError(
            path,
            f"names the trial in {len(trials)} of {len(stated)} rows of policy '{policy}'",
            "name it in all or in none",
        )
    if len(set(trials)) < len(trials):
        twice = next(trial for trial in trials if trials.count(trial) > 1)
        raise MalformedFileError(
            path, f"has trial {twice} of policy '{policy}' more than once", "keep the first attempt"
        )
    return trials


def read_twin_trials(paths: Sequence[Path]) -> dict[str, dict[int, int]]:
    """Read results, 0 or 1, by policy and trial, from files that `aomgen evaluate SUITE --policy P --json F` wrote.

    Raises:
        MalformedFileError: A file has other content.
        ConfigError: Two files evaluate the same policy, or use different suites.
    """
    found: dict[str, dict[int, int]] = {}
    homes: dict[str, Path] = {}
    suites: dict[str, Path] = {}
    for path in paths:
        figures = read_json(path)
        if not is_evaluation(figures):
            raise MalformedFileError(
                path, "contains no metrics of `aomgen evaluate`", "write them with --json"
            )
        policy = str(figures["policy"])
        if policy in found:
            raise ConfigError(
                path, f"evaluates policy '{policy}', and so does {homes[policy]}", "give one of them"
            )
        suites[str(figures["suite"])] = homes[policy] = path
        found[policy] = {int(row["trial"]): int(not row["fail_reason"]) for row in figures["rollouts"]}
    if len(suites) > 1:
        first, second = list(suites.values())[:2]
        raise ConfigError(
            second, f"belongs to another suite than {first}", "evaluate all policies on one suite"
        )
    return found


def is_evaluation(figures: Any) -> bool:
    """Return whether JSON values are the result of an evaluation in the twin."""
    return isinstance(figures, dict) and all(key in figures for key in FIGURES)


def compare_with_reality(
    real: Mapping[str, tuple[list[int], list[int]]], twin: Mapping[str, Mapping[int, int]], where: Path
) -> dict[str, Any]:
    """Compare success rates of policies on the real robot and in the twin, see `read_real_trials` and `read_twin_trials`.

    Returns:
        `policies` by name: `real` and `twin` (`successes`, `trials`, `success_rate`, Wilson's `interval_95`), `pairs`, and
        `combined` (see `RealSuccess`); `pearson_r` (None if it is undefined) and `mmrv` over policies.

    Raises:
        UnknownNameError: A policy was not evaluated in the twin.
        ConfigError: The suite does not contain a real trial.
    """
    policies: dict[str, Any] = {}
    for policy, (results, trials) in real.items():
        if policy not in twin:
            raise UnknownNameError(f"{where}: policy", policy, twin)
        judged = twin[policy]
        strange = sorted(set(trials) - set(judged))
        if strange:
            raise ConfigError(where, f"names trial {strange[0]}, which the suite does not have", "correct it")
        paired = [judged[trial] for trial in trials]
        rest = [result for trial, result in judged.items() if trial not in trials]
        policies[policy] = {
            "real": _rate(results),
            "twin": _rate(list(judged.values())),
            "pairs": len(paired),
            "combined": asdict(estimate_real_success(results, paired, rest)),
        }
    rates = [[item[kind]["success_rate"] for item in policies.values()] for kind in ("real", "twin")]
    return {
        "policies": policies,
        "pearson_r": correlate(*rates),
        "mmrv": mean_maximum_rank_violation(*rates),
    }


def _rate(results: Sequence[int]) -> dict[str, Any]:
    successes, trials = sum(results), len(results)
    return {
        "successes": successes,
        "trials": trials,
        "success_rate": successes / trials,
        "interval_95": interval_95(successes, trials),
    }
