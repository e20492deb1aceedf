"""Pieces of the report's HTML; one self-contained file, no script, no network."""

import base64
import html

import numpy as np
from numpy.typing import NDArray

from aomgen.io.images import encode_jpeg

STYLE = """
body{font:15px/1.5 system-ui,sans-serif;color:#1c2430;max-width:1080px;margin:0 auto;padding:24px}
h1{font-size:26px;margin:0 0 4px}h2{font-size:19px;margin:34px 0 6px;border-bottom:1px solid #d5dbe3;padding-bottom:3px}
p{margin:6px 0 10px;max-width:76ch}img{max-width:100%;display:block;margin:8px 0;border-radius:3px}
table{border-collapse:collapse;margin:8px 0;font-size:13.5px}td,th{padding:3px 10px;text-align:left;border-bottom:1px solid #e6eaf0}
td.n{text-align:right;font-variant-numeric:tabular-nums}
svg{width:100%;max-width:760px;background:#fafbfc;border:1px solid #e6eaf0}svg text{font-size:11px;fill:#4a5568}
.span{fill:#f5d76e;opacity:.45}.band{fill:#1f6f8b;opacity:.18}.grid{stroke:#e6eaf0}.level{stroke:#d1495b;stroke-dasharray:5 4}
.good{color:#2c7a4b}.bad{color:#b3261e}.dim{color:#66707f}
"""


def page(title: str, body: list[str]) -> str:
    """A whole HTML document."""
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{text(title)}</title>'
        f"<style>{STYLE}</style><body>{''.join(body)}</body></html>\n"
    )


def section(title: str, *parts: str) -> str:
    """A heading and what belongs under it."""
    return f"<h2>{text(title)}</h2>{''.join(parts)}"


def paragraph(words: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{text(words)}</p>"


def picture(image_srgb: NDArray[np.uint8], caption: str) -> str:
    """An embedded picture (H, W, 3) uint8."""
    data = base64.b64encode(encode_jpeg(image_srgb, 88)).decode()
    return f'<figure style="margin:0"><img src="data:image/jpeg;base64,{data}" alt="{text(caption)}"><figcaption class="dim">{text(caption)}</figcaption></figure>'


def table(header: list[str], rows: list[list[object]]) -> str:
    """A table; numbers stand right."""
    head = "".join(f"<th>{text(name)}</th>" for name in header)
    lines = []
    for row in rows:
        cells = "".join(
            f'<td class="n">{_number(value)}</td>' if _is_number(value) else f"<td>{text(value)}</td>"
            for value in row
        )
        lines.append(f"<tr>{cells}</tr>")
    return f"<table><tr>{head}</tr>{''.join(lines)}</table>"


def text(value: object) -> str:
    """Escaped text."""
    return html.escape(str(value))


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _number(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
