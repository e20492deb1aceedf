"""Distance of an episode's figures to their limits, comparable between figures."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from aomgen.pipeline.figures import FIGURES, read_figure

# Metrics by which planning compares attempts; a person cannot use them.
_INTERNAL: Final = ("in_contact", "path_share")


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitReading:
    """One figure against its limit, in words.

    Attributes:
        figure: Name with unit, for example "torque_share".
        name: In words.
        value, limit: With their unit; the limit with the sign of the inequality.
        room: Distance to the limit over that of the best value: 1 is the best value, 0 the limit.
        setting: Simulated resistance of the object in which the figure is worst; empty for figures of the plan.
    """

    figure: str
    name: str
    value: str
    limit: str
    room: float
    setting: str = ""


def read_limits(verdict: Mapping[str, Any]) -> list[LimitReading]:
    """All figures of a stored `Verdict` against their limits, the one nearest to its limit first.

    Raises:
        KeyError, TypeError, ValueError: It is no verdict of an episode.
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
    # A limit from below is that of a share, whose best value is 1.
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
    """Figures of a rejection in words, by their names in words."""
    found = {}
    for name, value in metrics.items():
        group = next((group for group in ("plan", "verdict") if name in FIGURES[group]), "")
        if group:
            reading = read_figure(group, name, value)
            found[reading.name] = reading.value
        elif name not in _INTERNAL:
            found[name.replace("_", " ")] = f"{value:.4g}"
    return found
