"""Distance of an episode's figures to their limits, comparable between figures; and the limit that a rejection states."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from aomgen.pipeline.figures import FIGURES, read_figure

# Rejections state their value and its limit in these forms; others have no limit that can be compared.
_STATED: Final = re.compile(r"(-?\d+(?:\.\d+)?(?:e[+-]?\d+)?)\D*?, (?:limit|at least) (-?\d+(?:\.\d+)?)")
# Metrics by which planning compares attempts; a person cannot use them.
_INTERNAL: Final = ("in_contact", "path_share")
_PAIR: Final = re.compile(r"\((\w+ and \w+)\)$")


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


def parse_excess(detail: str) -> float | None:
    """Parse the excess over the limit that a rejection's sentence states, as a share of the limit; None without a limit.

    Example:
        >>> parse_excess("penetration_mm is 3.0, limit 1.0 (wrist_1_link and table)")
        2.0
    """
    found = _STATED.search(detail)
    if found is None or float(found[2]) == 0:
        return None
    value, limit = float(found[1]), float(found[2])
    return abs(value - limit) / abs(limit)


def parse_pair(detail: str) -> str:
    """Parse the colliding bodies that a rejection's sentence names, for example "wrist_1_link and table"; empty for none."""
    found = _PAIR.search(detail)
    return found[1] if found else ""


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
