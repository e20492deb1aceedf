"""Margins of an episode's metrics to their limits, normalized so that metrics can be compared."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from aomgen.pipeline.figures import FIGURES, read_figure

# Metrics by which planning compares candidates; a person cannot use them.
_INTERNAL: Final = ("in_contact", "path_share")


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitReading:
    """One metric and its limit, in words.

    Attributes:
        figure: Name of the metric with unit, for example "torque_share".
        name: Name in words.
        value, limit: Value and limit with their unit; the limit with its inequality sign.
        room: Normalized margin, the margin divided by that of the best value: 1 at the best value, 0 at the limit.
        setting: Simulated setting of the object in which the metric is worst; empty for metrics of the plan.
    """

    figure: str
    name: str
    value: str
    limit: str
    room: float
    setting: str = ""


def read_limits(verdict: Mapping[str, Any]) -> list[LimitReading]:
    """List all metrics of a stored `Verdict` with their limits, the smallest normalized margin first.

    Raises:
        KeyError, TypeError, ValueError: The values are not a verdict of an episode.
    """
    found = [
        _read(name, item["value"], item["limit"], item["margin"], "")
        for name, item in verdict["kinematic"].items()
    ]
    for name, margin in verdict["margins"].items():
        limit, runs = verdict["limits"][name], verdict["dynamic"]
        worst = min(runs, key=lambda run: abs(abs(run[name] - limit) - margin))
        found.append(_read(name, worst[name], limit, margin, worst["name"]))
    return sorted(found, key=lambda item: item.room)


def _read(name: str, value: float, limit: float, margin: float, setting: str) -> LimitReading:
    # Only shares have a lower limit; their best value is 1.
    least = value - limit == margin and value != limit
    group = "verdict" if setting else "plan"
    shown, stated = (read_figure(group, name, number) for number in (value, limit))
    return LimitReading(
        figure=name,
        name=shown.name,
        value=shown.value,
        limit=f"{'≥' if least else '≤'} {stated.value}",
        room=margin / ((1 - limit) if least else limit),
        setting=setting,
    )


def read_rejected(metrics: Mapping[str, float]) -> dict[str, str]:
    """Describe the metrics of a rejection in words, by their names in words."""
    found = {}
    for name, value in metrics.items():
        group = next((group for group in ("plan", "verdict") if name in FIGURES[group]), "")
        if group:
            reading = read_figure(group, name, value)
            found[reading.name] = reading.value
        elif name not in _INTERNAL:
            found[name.replace("_", " ")] = f"{value:.4g}"
    return found
