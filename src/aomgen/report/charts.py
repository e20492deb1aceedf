"""Small line charts as SVG text."""

from dataclasses import dataclass, field

import numpy as np

from aomgen.core.values import Array

WIDTH, HEIGHT = 760, 220
LEFT, RIGHT, TOP, BOTTOM = 54, 12, 14, 34
COLORS = ("#1f6f8b", "#d1495b", "#66a182", "#8d6a9f")


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """Curves over a common x axis.

    Attributes:
        x_label, y_label: Axis titles with units.
        curves: (name, x (N,), y (N,)) each.
        level: (name, y) of a horizontal line, or None.
        span: Shaded interval of x, or None.
        band: (x, low, high) of a shaded uncertainty band, or None.
    """

    x_label: str
    y_label: str
    curves: list[tuple[str, Array, Array]]
    level: tuple[str, float] | None = None
    span: tuple[float, float] | None = None
    band: tuple[Array, Array, Array] | None = field(default=None)


def draw_chart(chart: Chart) -> str:
    """SVG text of a chart."""
    xs = np.concatenate([x for _, x, _ in chart.curves])
    shown = [y for _, _, y in chart.curves]
    shown += [np.array([chart.level[1]])] if chart.level else []
    shown += chart.band[1:] if chart.band else []
    ys = np.concatenate(shown)
    x_range, y_range = (xs.min(), xs.max()), (min(0.0, ys.min()), ys.max() * 1.08 or 1.0)

    def px(x: Array | float) -> Array:
        return LEFT + (np.asarray(x) - x_range[0]) / max(x_range[1] - x_range[0], 1e-12) * (
            WIDTH - LEFT - RIGHT
        )

    def py(y: Array | float) -> Array:
        share = (np.asarray(y) - y_range[0]) / max(y_range[1] - y_range[0], 1e-12)
        return HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)

    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{chart.y_label} over {chart.x_label}">'
    ]
    if chart.span:
        left, right = px(chart.span[0]), px(chart.span[1])
        parts.append(
            f'<rect x="{left:.1f}" y="{TOP}" width="{right - left:.1f}" height="{HEIGHT - TOP - BOTTOM}" class="span"/>'
        )
    if chart.band:
        x, low, high = chart.band
        outline = [*zip(px(x), py(low), strict=True), *zip(px(x)[::-1], py(high)[::-1], strict=True)]
        parts.append(f'<polygon points="{_points(outline)}" class="band"/>')
    parts += [_y_tick(value, float(py(value))) for value in _ticks(*y_range)]
    parts += [_x_tick(value, float(px(value))) for value in _ticks(*x_range)]
    if chart.level:
        y = float(py(chart.level[1]))
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" class="level"/>')
        parts.append(f'<text x="{WIDTH - RIGHT}" y="{y - 4:.1f}" text-anchor="end">{chart.level[0]}</text>')
    for index, (name, x, y) in enumerate(chart.curves):
        color = COLORS[index % len(COLORS)]
        points = _points(list(zip(px(x), py(y), strict=True)))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="1.6"/>')
        parts.append(f'<text x="{LEFT + 8 + 150 * index}" y="{TOP + 8}" style="fill:{color}">{name}</text>')
    parts.append(
        f'<text x="{(LEFT + WIDTH) / 2}" y="{HEIGHT - 4}" text-anchor="middle">{chart.x_label}</text>'
    )
    parts.append(
        f'<text transform="translate(12 {HEIGHT / 2}) rotate(-90)" text-anchor="middle">{chart.y_label}</text></svg>'
    )
    return "".join(parts)


def _points(pairs: list) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in pairs)


def _ticks(low: float, high: float) -> list[float]:
    """About five round numbers inside a range."""
    step = 10.0 ** np.floor(np.log10(max(high - low, 1e-12) / 4))
    while (high - low) / step > 6:
        step *= 2 if (high - low) / step < 12 else 2.5
    first = np.ceil(low / step) * step
    # Zero may come out as minus zero, which would be written so.
    return [float(value) + 0.0 for value in np.arange(first, high + 1e-9 * step, step)]


def _x_tick(value: float, x: float) -> str:
    return f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 14}" text-anchor="middle">{value:g}</text>'


def _y_tick(value: float, y: float) -> str:
    return (
        f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>'
        f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:.3g}</text>'
    )
