"""Pieces of the report's HTML, charts included; one file without script or network; videos are separate files."""

import base64
import html
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array
from aomgen.io.images import encode_jpeg
from aomgen.pipeline.figures import Reading

STYLE = """
body{font:15px/1.5 system-ui,sans-serif;color:#1c2430;max-width:1120px;margin:0 auto;padding:24px}
h1{font-size:26px;margin:0 0 8px}h2{font-size:20px;margin:40px 0 8px;border-bottom:1px solid #d5dbe3;padding-bottom:4px}
h3{font-size:15.5px;margin:20px 0 4px}p{margin:6px 0 10px;max-width:80ch}a{color:#1f6f8b}
img{max-width:100%;display:block;margin:8px 0;border-radius:3px}figure{margin:0}
table{border-collapse:collapse;margin:8px 0;font-size:13.5px}
td,th{padding:3px 12px 3px 0;text-align:left;vertical-align:top;border-bottom:1px solid #e6eaf0}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}td.n,.whole{white-space:nowrap}th{vertical-align:bottom}
svg{width:100%;max-width:760px;background:#fafbfc;border:1px solid #e6eaf0}svg text{font-size:11px;fill:#4a5568}
.span{fill:#f5d76e;opacity:.45}.band{fill:#1f6f8b;opacity:.18}.grid{stroke:#e6eaf0}.level{stroke:#d1495b;stroke-dasharray:5 4}
.wide{max-width:none}.good{color:#2c7a4b}.poor{color:#b3261e;font-weight:600}.dim{color:#66707f}
code,pre{font:13px/1.45 ui-monospace,monospace}
pre{background:#f4f6f8;padding:8px 12px;border-radius:4px;overflow-x:auto;margin:4px 0 12px}
.bar{background:#1f6f8b;height:11px;margin-top:5px;border-radius:2px;min-width:1px}
.head{display:flex;flex-wrap:wrap;gap:0 48px}
.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(500px,1fr));gap:18px 20px;margin:12px 0}
.card figcaption{font-size:13px}.card b{font-size:14px}
summary{color:#1f6f8b;cursor:pointer}
.views{display:grid;grid-template-columns:repeat(2,1fr);gap:4px}video{width:100%;display:block;background:#e6eaf0;border-radius:3px}
"""


X_LABEL = "video time [s]"
# Size of a chart, and the margins of its curves, [px].
WIDTH, HEIGHT = 760, 220
LEFT, RIGHT, TOP, BOTTOM = 54, 12, 14, 34
COLORS = ("#1f6f8b", "#d1495b", "#66a182", "#8d6a9f")


class Markup(str):
    """Text that is HTML already, as a cell of a table."""

    __slots__ = ()


def page(title: str, body: list[str]) -> str:
    """Write a whole HTML document."""
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width"><title>{text(title)}</title>'
        f"<style>{STYLE}</style><body>{''.join(body)}</body></html>\n"
    )


def section(title: str, *parts: str) -> str:
    """Write a heading and the content of its section."""
    return f'<h2 id="{_anchor(title)}">{text(title)}</h2>{"".join(parts)}'


def contents(titles: list[str]) -> str:
    """Write links to sections."""
    return f'<p class="wide">{" · ".join(link("#" + _anchor(title), title) for title in titles)}</p>'


def heading(words: str) -> str:
    """Write a heading inside a section."""
    return f"<h3>{text(words)}</h3>"


def paragraph(words: str) -> str:
    """Write a paragraph of plain text."""
    return f"<p>{text(words)}</p>"


def fold(title: str, content: str, *, opened: bool) -> str:
    """Write content that a reader can fold and unfold."""
    return f"<details{' open' if opened else ''}><summary>{text(title)}</summary>{content}</details>"


def commands(words: str) -> str:
    """Write command lines."""
    return f"<pre>{text(words)}</pre>"


def picture(image_srgb: NDArray[np.uint8], caption: str) -> str:
    """Embed an image (H, W, 3) uint8."""
    return (
        f'<figure><img src="{jpeg_url(image_srgb, 88)}" alt="{text(caption)}">'
        f'<figcaption class="dim">{text(caption)}</figcaption></figure>'
    )


def jpeg_url(image_srgb: NDArray[np.uint8], quality: int) -> str:
    """Encode an image (H, W, 3) uint8 as a data URL."""
    return f"data:image/jpeg;base64,{base64.b64encode(encode_jpeg(image_srgb, quality)).decode()}"


def video(link: str, poster_srgb: NDArray[np.uint8], label: str) -> str:
    """Write a player that loads its video only when it is started; the poster (H, W, 3) is embedded."""
    height, width = poster_srgb.shape[:2]
    return (
        f'<video controls muted playsinline preload="none" width="{width}" height="{height}" '
        f'style="aspect-ratio:{width}/{height};height:auto" '
        f'poster="{jpeg_url(poster_srgb, 80)}" src="{text(link)}" title="{text(label)}"></video>'
    )


def link(target: str, words: str) -> str:
    """Write a link to a file next to the page."""
    return f'<a href="{text(target)}">{text(words)}</a>'


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Write a table; columns of numbers are aligned to the right with the digits that the caller formatted."""
    numeric = [_is_number(value) for value in rows[0]] if rows else [False] * len(header)
    head = "".join(_cell(name, "th", right) for name, right in zip(header, numeric, strict=True))
    lines = "".join(f"<tr>{''.join(_cell(value) for value in row)}</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{lines}</table>"


def reading(item: Reading) -> str:
    """Write a figure with its name, colored if it has a limit; the sentence also states that it violates the limit."""
    return f'<span class="{item.verdict}">{text(item.sentence)}</span>'


def bar(share: float) -> Markup:
    """Write a bar whose length is a share of its cell, 0..1."""
    return Markup(f'<div class="bar" style="width:{100 * share:.1f}%"></div>')


def whole(words: str) -> Markup:
    """Write a cell's text without line breaks."""
    return Markup(f'<span class="whole">{text(words)}</span>')


def text(value: object) -> str:
    """Escape a value for HTML."""
    return html.escape(str(value))


def _anchor(title: str) -> str:
    return text(title.lower().replace(" ", "-"))


def _cell(value: object, tag: str = "td", right: bool = False) -> str:
    if isinstance(value, Markup):
        return f"<{tag}>{value}</{tag}>"
    kind = ' class="n"' if right or _is_number(value) else ""
    return f"<{tag}{kind}>{text(value)}</{tag}>"


def _is_number(value: object) -> bool:
    """Check whether a value is a number or a string of digits; markup is none."""
    if isinstance(value, Markup):
        return False
    if isinstance(value, str):
        return value.replace(",", "").replace(".", "", 1).lstrip("-").isdigit()
    return isinstance(value, int) and not isinstance(value, bool)


def draw_chart(
    y_label: str,
    curves: Sequence[tuple[str, Array, Array]],
    *,
    level: tuple[str, float] | None = None,
    span: tuple[float, float] | None = None,
    band: tuple[Array, Array, Array] | None = None,
) -> str:
    """Draw curves over video time as SVG.

    Args:
        y_label: Label of the y axis with its unit.
        curves: Name, times [s] and values of each.
        level: Name and value of a horizontal line.
        span: Shaded interval of time, [s].
        band: Times, lower and upper bounds of a shaded uncertainty band.
    """
    xs = np.concatenate([x for _, x, _ in curves])
    shown = [y for _, _, y in curves]
    shown += [np.array([level[1]])] if level else []
    shown += band[1:] if band else []
    ys = np.concatenate(shown)
    x_range, y_range = (xs.min(), xs.max()), (min(0.0, ys.min()), ys.max() * 1.08 or 1.0)

    def px(x: Array | float) -> Array:
        share = (np.asarray(x) - x_range[0]) / max(x_range[1] - x_range[0], 1e-12)
        return LEFT + share * (WIDTH - LEFT - RIGHT)

    def py(y: Array | float) -> Array:
        share = (np.asarray(y) - y_range[0]) / max(y_range[1] - y_range[0], 1e-12)
        return HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{y_label} over {X_LABEL}">']
    if span:
        left, right = px(span[0]), px(span[1])
        parts.append(
            f'<rect x="{left:.1f}" y="{TOP}" width="{right - left:.1f}" height="{HEIGHT - TOP - BOTTOM}" class="span"/>'
        )
    if band:
        x, low, high = band
        outline = [*zip(px(x), py(low), strict=True), *zip(px(x)[::-1], py(high)[::-1], strict=True)]
        parts.append(f'<polygon points="{_points(outline)}" class="band"/>')
    for value, y in ((tick, float(py(tick))) for tick in _ticks(*y_range)):
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:.3g}</text>')
    for value, x in ((tick, float(px(tick))) for tick in _ticks(*x_range)):
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 14}" text-anchor="middle">{value:g}</text>')
    if level:
        y = float(py(level[1]))
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" class="level"/>')
        parts.append(f'<text x="{WIDTH - RIGHT}" y="{y - 4:.1f}" text-anchor="end">{level[0]}</text>')
    for index, (name, x, y) in enumerate(curves):
        color = COLORS[index % len(COLORS)]
        points = _points(list(zip(px(x), py(y), strict=True)))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="1.6"/>')
        parts.append(f'<text x="{LEFT + 8 + 150 * index}" y="{TOP + 8}" style="fill:{color}">{name}</text>')
    parts.append(f'<text x="{(LEFT + WIDTH) / 2}" y="{HEIGHT - 4}" text-anchor="middle">{X_LABEL}</text>')
    parts.append(
        f'<text transform="translate(12 {HEIGHT / 2}) rotate(-90)" text-anchor="middle">{y_label}</text></svg>'
    )
    return "".join(parts)


def _points(pairs: list) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in pairs)


def _ticks(low: float, high: float) -> list[float]:
    """List about five round numbers inside a range."""
    step = 10.0 ** np.floor(np.log10(max(high - low, 1e-12) / 4))
    while (high - low) / step > 6:
        step *= 2 if (high - low) / step < 12 else 2.5
    first = np.ceil(low / step) * step
    # The sum converts -0.0 to 0.0, so that no tick is labeled -0.
    return [float(value) + 0.0 for value in np.arange(first, high + 1e-9 * step, step)]
