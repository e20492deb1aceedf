"""The report's section on the draws: what was asked for, what was delivered, and where objects could stand."""

from collections.abc import Mapping
from typing import Any

from aomgen.core.plan import Variation
from aomgen.episodes.distributions import Distribution, distributions
from aomgen.episodes.factory import GenerationParams
from aomgen.episodes.ledger import read_draws
from aomgen.episodes.map_drawing import OUTCOMES, Shape, draw_map, front_line, scene_shapes
from aomgen.episodes.reach_map import REACH_MAP, ReachMap
from aomgen.io.artifact import load_artifact
from aomgen.report.html import paragraph, text
from aomgen.results import Results

# Of one histogram, [px].
WIDTH, HEIGHT = 230, 92


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
            "The places from above, the robot at the cross; a line points where the object's front looks. Green: an "
            "episode. Red: planned in vain. Grey: not worth planning; the reasons follow below. Pale green below: where "
            "the arm can hold the handle, the stronger, the more turns of the object. Brown: the free table; dark "
            "boxes: what else stands there."
        ),
        _map(results, draws),
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
            (item.delivered, OUTCOMES["committed"]),
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


def _map(results: Results, draws: list[dict[str, Any]]) -> str:
    """Where the objects of all draws stand, on what the scene and the reach of the arm allow."""
    folder, count = results.folders["episodes"], len(results.fitted_assets)
    maps = [load_artifact(folder, REACH_MAP.format(number), ReachMap) for number in range(count)]
    ordered = sorted(draws, key=lambda draw: list(OUTCOMES)[::-1].index(draw["outcome"]))
    lines = [_line(results, draw) for draw in ordered]
    return draw_map([*scene_shapes(results.episode_scene, maps), *lines])


def _line(results: Results, draw: Mapping[str, Any]) -> Shape:
    stored = draw["variation"]
    place = {name: stored[name] for name in ("seed", "index", "x", "y", "yaw", "frame")}
    return front_line(results.fitted_assets[draw["asset"]], Variation(**place), draw["outcome"])
