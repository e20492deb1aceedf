"""The report's section on the draws: what was asked for, what was delivered, and where objects could stand."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from aomgen.core.plan import Variation
from aomgen.episodes.distributions import Distribution, distributions
from aomgen.episodes.factory import GenerationParams
from aomgen.episodes.ledger import read_draws
from aomgen.report.html import paragraph, text
from aomgen.results import Results

# Of one histogram, [px].
WIDTH, HEIGHT = 230, 92
# Of the map: length of an arrow, [m], and room around the outermost object, [m].
ARROW_M, ROOM_M = 0.06, 0.08
# Of the map, [px].
MAP_WIDTH: Final = 480
COLORS: Final = {"committed": "#2c7a4b", "rejected": "#d1495b", "skipped": "#b9c2cf"}


def draws_section(results: Results) -> list[str]:
    """Histograms of everything that differs, and a map of the places."""
    draws = read_draws(results.folders["episodes"])
    if not draws:
        return []
    params = results.params("episodes", GenerationParams())
    found = distributions(draws, params.ranges, params.free_cameras)
    charts = "".join(draw_histogram(item) for item in found)
    return [
        paragraph(
            "Grey: all draws, spread evenly over the range asked for. Blue: those that were planned. Green: those that "
            "became episodes."
        ),
        f'<div class="head">{charts}</div>',
        paragraph(
            "The places from above, the robot at the cross; an arrow points where the object's front looks. Green: an "
            "episode. Red: planned in vain. Grey: not worth planning; the reasons follow below."
        ),
        draw_map(results, draws),
    ]


def draw_histogram(item: Distribution) -> str:
    """One small chart."""
    count, tallest = len(item.drawn), max(int(item.drawn.max()), 1)
    wide = WIDTH / count
    bars = "".join(
        f'<rect x="{k * wide + 1:.1f}" y="{14 + 56 * (1 - number / tallest):.1f}" width="{wide - 2:.1f}" '
        f'height="{56 * number / tallest:.1f}" fill="{color}"/>'
        for numbers, color in (
            (item.drawn, "#dde2e9"),
            (item.tried, "#9fc3d0"),
            (item.delivered, COLORS["committed"]),
        )
        for k, number in enumerate(numbers.tolist())
    )
    name = f"{item.name} [{item.unit}]" if item.unit else item.name
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" style="width:{WIDTH}px">{bars}'
        f'<text x="2" y="11">{text(name)}: {item.delivered.sum()} of {item.drawn.sum()}</text>'
        f'<text x="2" y="{HEIGHT - 6}">{item.edges[0]:g}</text>'
        f'<text x="{WIDTH - 2}" y="{HEIGHT - 6}" text-anchor="end">{item.edges[-1]:g}</text></svg>'
    )


def draw_map(results: Results, draws: list[dict[str, Any]]) -> str:
    """Where the objects of all draws stand, the robot's base at the origin, x to the right."""
    arrows = [(_arrow(results, draw), COLORS[draw["outcome"]]) for draw in draws]
    points = np.concatenate([np.zeros((1, 2)), *(arrow for arrow, _ in arrows)])
    low, high = points.min(0) - ROOM_M, points.max(0) + ROOM_M
    scale = MAP_WIDTH / (high[0] - low[0])
    height = scale * (high[1] - low[1])

    def at(point: np.ndarray) -> str:
        return f"{scale * (point[0] - low[0]):.1f},{height - scale * (point[1] - low[1]):.1f}"

    lines = "".join(
        f'<polyline points="{at(start)} {at(end)}" stroke="{color}" stroke-width="2" fill="none"/>'
        f'<circle r="3" fill="{color}" transform="translate({at(start)})"/>'
        for (start, end), color in sorted(arrows, key=lambda item: list(COLORS.values())[::-1].index(item[1]))
    )
    foot = np.zeros(2)
    return (
        f'<svg viewBox="0 0 {MAP_WIDTH} {height:.0f}" style="max-width:{MAP_WIDTH}px">'
        f'<path d="M{at(foot)}m-7,0h14m-7,-7v14" stroke="#1c2430" stroke-width="2"/>{lines}</svg>'
    )


def _arrow(results: Results, draw: Mapping[str, Any]) -> np.ndarray:
    """From the middle of an object to before its front (2, 2), seen from above, world frame."""
    fitted, stored = results.fitted_assets[draw["asset"]], draw["variation"]
    place = {name: stored[name] for name in ("seed", "index", "x", "y", "yaw", "frame")}
    T = Variation(**place).placed(fitted)
    low, high = fitted.asset.static.bounds
    middle = np.append((low + high)[:2] / 2, 0.0)
    ends = np.stack([middle, middle - [0.0, ARROW_M, 0.0]])
    return (ends @ T[:3, :3].T + T[:3, 3])[:, :2]
