"""Metrics of many motion worlds: median, 90th percentile, refusals, failures, with their thresholds."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np

from benchmarks.motion_accuracy import Outcome
from benchmarks.table import as_table

# Shortest and longest moving share of a video for which start and end have to be found.
SHARES: Final = (0.05, 0.80)
# A stated interval may be this many times as wide as the median error.
WIDEST: Final = 3.0
# Bounds of the groups of moving shares, and largest error of start or end, [s].
FRACTIONS: Final = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 1.0)
SOON_S: Final = 0.2
COUNTS: Final = (
    "worlds",
    "refusals",
    "wrong_type",
    "failures",
    "wrong_direction",
    "cpu_s_median",
    "cpu_s_worst",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionBar:
    """Limits on a metric; None where there is no limit."""

    median: float | None
    p90: float | None = None


BARS: Final[dict[str, MotionBar]] = {
    "joint.axis_deg": MotionBar(median=0.7, p90=2.0),
    "joint.origin_mm": MotionBar(median=4.0, p90=10.0),
    "theta.rmse_deg": MotionBar(median=0.7),
    "theta.rmse_mm": MotionBar(median=2.0),
    "contact_mm": MotionBar(median=6.0),
    "keyframes.start_error_s": MotionBar(median=None, p90=0.2),
    "keyframes.end_error_s": MotionBar(median=None, p90=0.2),
}
# Metrics that a joint of the other type does not have.
OF_TYPE: Final = {"joint.origin_mm": "revolute", "theta.rmse_deg": "revolute", "theta.rmse_mm": "prismatic"}


def percentile(values: Sequence[float], share: float) -> float | None:
    """Compute the linear percentile of values; None where it is an infinity (failure), or without values."""
    if not values:
        return None
    ordered = np.sort(np.asarray(values, np.float64))
    place = share * (len(ordered) - 1)
    low, high = ordered[int(np.floor(place))], ordered[int(np.ceil(place))]
    if not np.isfinite(high):
        return None
    return float(low + (place - np.floor(place)) * (high - low))


def summaries_of(outcomes: Sequence[Outcome]) -> dict[str, dict[str, Any]]:
    """Compute `summary` of ours on solvable worlds, of other methods, and of ours by category and kind."""
    groups: dict[str, list[Outcome]] = {"all": []}
    for outcome in sorted(
        outcomes, key=lambda outcome: (outcome.case.group == "beyond", outcome.method != "ours")
    ):
        case = outcome.case
        if case.group == "beyond" and outcome.method == "ours":
            groups.setdefault(f"({case.category if case.kind == 'open' else case.kind})", []).append(outcome)
        elif case.group == "solvable" and outcome.method == "ours":
            groups["all"].append(outcome)
            groups.setdefault(case.category, []).append(outcome)
        elif case.group == "solvable":
            groups.setdefault(outcome.method, []).append(outcome)
    return {group: summary(members) for group, members in groups.items()}


def unsolvable_of(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Make one row per kind of unsolvable world, then all: refusals, and those with the right reason."""
    asked = [o for o in outcomes if o.case.group == "unsolvable" and o.method == "ours"]
    kinds = sorted({outcome.case.kind for outcome in asked})
    groups = {kind: [o for o in asked if o.case.kind == kind] for kind in kinds} | {"all": asked}
    return [
        {
            "unsolvable": kind,
            "worlds": len(members),
            "rightly_refused": sum(outcome.rightly_refused for outcome in members),
            "refused_otherwise": sum(
                bool(outcome.refusal) and not outcome.rightly_refused for outcome in members
            ),
            "answered": sum(not outcome.refusal for outcome in members),
            "share": sum(outcome.rightly_refused for outcome in members) / len(members) if members else None,
        }
        for kind, members in groups.items()
    ]


def fractions_of(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Compute errors of start and end against the share of the video in which the part moves."""
    asked = [o for o in outcomes if o.case.group == "solvable" and o.method == "ours"]
    rows = []
    for low, high in pairwise(FRACTIONS):
        members = [outcome for outcome in asked if low <= outcome.moving_share < high]
        row: dict[str, Any] = {"moving_share": f"{low:g}-{high:g}", "worlds": len(members)}
        for name in ("start", "end"):
            errors = [outcome.error(f"keyframes.{name}_error_s") for outcome in members]
            row[f"{name}_median_s"], row[f"{name}_worst_s"] = percentile(errors, 0.5), percentile(errors, 1.0)
            row[f"{name}_within"] = sum(error <= SOON_S for error in errors)
        rows.append(row)
    return rows


def told(outcome: Outcome) -> str:
    """Format one line of progress."""
    case = outcome.case
    name = f"{case.category}-{case.seed} {case.kind} {outcome.method} {outcome.seconds:.1f} s"
    if outcome.refusal:
        return f"{name}  {outcome.refusal}: {outcome.reason}"
    shown = {key: outcome.figures[key] for key in ("joint.type_ok", *BARS) if key in outcome.figures}
    return f"{name}  " + "  ".join(
        f"{key} {value:.3g}" if isinstance(value, float) else f"{key} {value}" for key, value in shown.items()
    )


def summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Compute median and 90th percentile of every metric with counts, of one method."""
    figures: dict[str, Any] = {
        "worlds": len(outcomes),
        "refusals": sum(bool(outcome.refusal) for outcome in outcomes),
        "wrong_type": sum(outcome.failed and not outcome.refusal for outcome in outcomes),
        "failures": sum(outcome.failed for outcome in outcomes),
        "wrong_direction": sum(outcome.figures.get("direction_ok") is False for outcome in outcomes),
        "cpu_s_median": percentile([outcome.seconds for outcome in outcomes], 0.5),
        "cpu_s_worst": percentile([outcome.seconds for outcome in outcomes], 1.0),
    }
    for name in BARS:
        asked = [
            outcome
            for outcome in outcomes
            if OF_TYPE.get(name) in (None, outcome.joint_type)
            and (not name.startswith("keyframes.") or SHARES[0] <= outcome.moving_share <= SHARES[1])
        ]
        errors = [outcome.error(name) for outcome in asked]
        figures[name] = {"median": percentile(errors, 0.5), "p90": percentile(errors, 0.9), "of": len(asked)}
    return figures | {"intervals": _intervals(outcomes)}


def _intervals(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Compute the share of truth within the 95 % intervals; their median half-width over the median error."""
    result = {}
    pairs = {
        "axis": ("axis_deg", "joint.axis_deg"),
        "origin": ("origin_mm", "joint.origin_mm"),
        "theta_deg": ("theta_deg", "theta.rmse_deg"),
        "theta_mm": ("theta_mm", "theta.rmse_mm"),
    }
    for name, (width, error) in pairs.items():
        told = [o.figures for o in outcomes if not o.failed and f"half_width.{width}" in o.figures]
        if not told:
            continue
        median_error = float(np.median([figures[error] for figures in told]))
        median_width = float(np.median([figures[f"half_width.{width}"] for figures in told]))
        result[name] = {
            "inside": float(np.mean([figures[f"inside.{name.split('_')[0]}"] for figures in told])),
            "half_width_over_error": median_width / max(median_error, 1e-9),
        }
    return result


def motion_table(summaries: dict[str, dict[str, Any]]) -> str:
    """Format one row per metric, median / 90th percentile of every group.

    Args:
        summaries: `summary` by group, for example "all", "drawer", "paper".
    """
    rows = []
    for name, bar in BARS.items():
        wanted = " / ".join("-" if limit is None else f"{limit:g}" for limit in (bar.median, bar.p90))
        cells = {group: _pair(figures[name]) for group, figures in summaries.items()}
        rows.append({"figure": name, "wanted": wanted} | cells)
    for name in COUNTS:
        cells = {group: figures[name] for group, figures in summaries.items()}
        rows.append({"figure": name, "wanted": "<= 60" if name == "cpu_s_worst" else "-"} | cells)
    for name in ("axis", "origin", "theta_deg", "theta_mm"):
        for key, wanted in (("inside", ".91-.98"), ("half_width_over_error", f"<= {WIDEST:g}")):
            cells = {
                group: figures["intervals"].get(name, {}).get(key) for group, figures in summaries.items()
            }
            rows.append({"figure": f"{name} {key}", "wanted": wanted} | cells)
    return as_table(rows)


def _pair(figure: dict[str, Any]) -> str:
    if not figure["of"]:
        return "-"
    return " / ".join("fails" if figure[key] is None else f"{figure[key]:.3g}" for key in ("median", "p90"))
