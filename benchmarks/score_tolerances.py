"""Tolerances for metrics after a change, relative to those before it."""

import re
from typing import Any, Final, NamedTuple

from aomgen.evaluation.evaluate import interval_95

# Allowed loss of images, [dB], and of errors, times and rates, as a share.
PSNR_DB, SHARE = 0.2, 0.05
PSNR: Final = re.compile(r"psnr|(^|[._])db($|[._])")
# A metric's statistic may follow its name: joint.axis_deg.median, contact_mm_worst.
STATISTIC: Final = r"([._](median|worst|p90|at_end))?$"
LOWER_IS_BETTER: Final = re.compile(
    r"(_(deg|mm|m|s|ms|px|pct|mb)|error|rmse|(^|\.)seconds(\.\w+)?|core_seconds\.\w+|_width)" + STATISTIC
)
HIGHER_IS_BETTER: Final = re.compile(r"(iou|per_minute|per_second|registered)" + STATISTIC)
# Shares of successes, by the metric next to them that counts the trials.
RATES: Final = {
    "success_rate": "attempts",
    "planned_share": "feasible",
    "axis_held": "worlds",
    "origin_held": "worlds",
    "accepted_share": "assets",
    "share": "worlds",
}
# Counts of failures, by the metric that counts the trials.
FAILURES: Final = {
    "refusals": "worlds",
    "wrong_type": "worlds",
    "failures": "worlds",
    "wrong_direction": "worlds",
    "rejected": "attempts",
}


class Judged(NamedTuple):
    """A metric before and after; `verdict` is same, better, worse, missing or new."""

    figure: str
    before: float | None
    after: float | None
    tolerance: str
    verdict: str

    @property
    def passes(self) -> bool:
        return self.verdict not in ("worse", "missing")


def judge(before: dict[str, float], after: dict[str, float]) -> list[Judged]:
    """Judge each metric that has a tolerance, or that only one side has, as one row.

    Args:
        before: Metrics by dotted name.
        after: Metrics measured with the same command and seeds.
    """
    rows = []
    for name in sorted(before.keys() | after.keys()):
        old, new = before.get(name), after.get(name)
        if new is None:
            rows.append(Judged(name, old, None, "", "missing"))
        elif old is None:
            rows.append(Judged(name, None, new, "", "new"))
        elif (found := _judge_one(name, before, after)) is not None:
            rows.append(Judged(name, old, new, *found))
    return rows


def as_rows(judged: list[Judged]) -> list[dict[str, Any]]:
    """Convert to rows of a table."""
    return [row._asdict() for row in judged]


def _judge_one(name: str, before: dict[str, float], after: dict[str, float]) -> tuple[str, str] | None:
    """Compute tolerance and verdict; None if no tolerance is stated for such a metric."""
    old, new = before[name], after[name]
    place, _, last = name.rpartition(".")
    if last in RATES and (trials := before.get(f"{place}.{RATES[last]}")):
        low, high = interval_95(round(old * trials), round(trials))
        return f"{low:.2f}..{high:.2f}", _verdict(new - old, old - low, high - old)
    if last in FAILURES:
        trials = before.get(f"{place}.{FAILURES[last]}", 0)
        low, high = (
            (trials * share for share in interval_95(round(old), round(trials))) if trials else (old, old)
        )
        return f"{low:.1f}..{high:.1f}", _verdict(old - new, high - old, old - low)
    if PSNR.search(name):
        return f"{PSNR_DB} dB", _verdict(new - old, PSNR_DB, PSNR_DB)
    slack = SHARE * abs(old)
    if LOWER_IS_BETTER.search(name):
        return f"{SHARE:.0%}", _verdict(old - new, slack, slack)
    if HIGHER_IS_BETTER.search(name):
        return f"{SHARE:.0%}", _verdict(new - old, slack, slack)
    return None


def _verdict(gain: float, may_lose: float, may_gain: float) -> str:
    """Judge a gain, positive where the metric is better now; NaN is worse."""
    if not gain >= -may_lose - 1e-12:
        return "worse"
    return "better" if gain > may_gain + 1e-12 else "same"
