"""A page about a capture before anything is computed from it: warnings, and the scan's images with the worst first."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from aomgen.capture.scan_images import BLURRED, blur
from aomgen.core.recording import Prompt, Recording
from aomgen.core.walk import describe_walk
from aomgen.io.atomic import write_text
from aomgen.io.images import read_image, resize
from aomgen.report.html import jpeg_url, page, paragraph, picture, section, table, text
from aomgen.structure.overlap import MIN_WALK, ScanOverlap

# Width of a thumbnail, [px]; three fit into the width of the page.
THUMBNAIL_PX: Final = 320
# Approximate width of the overlap matrix; pairs of 64 images then have 7 px, [px].
MATRIX_PX: Final = 480
# Side of the plan of the walk, [px], over twice the distance of the farthest camera.
PLAN_PX: Final = 420
# Margin of the plan, relative to the distance of the farthest camera, so that its sector is visible.
PLAN_MARGIN: Final = 1.15
# Points on the rim of the sector without images.
SECTOR_POINTS: Final = 24
# Number of matches from which on a pair has the largest brightness.
MANY_MATCHES: Final = 100
# Colors of the parts, as in `aomgen prompts`.
COLORS: Final = {"robot": (209, 73, 91), "static": (31, 111, 139), "moving": (232, 163, 61)}


def write_capture_page(
    path: Path,
    capture: Recording,
    greys: Mapping[str, NDArray[np.float32]],
    overlap: ScanOverlap,
    facts: str,
    warnings: Sequence[str],
) -> None:
    """Write the page, one file without script or network.

    Args:
        path: HTML file.
        greys: Grey levels (H, W) of the scan images by name, see `scan_images.read_grey`.
        overlap: Overlap of the same images.
        facts: Lines about robot, scan, videos and log.
        warnings: Sentences.
    """
    cards = [
        _draw_card(capture, overlap, index, blur(greys[name])) for index, name in enumerate(overlap.names)
    ]
    worst_first = sorted(cards, key=lambda card: card[0], reverse=True)
    body = [
        f"<h1>Capture {text(capture.name)}</h1>",
        f"<pre>{text(facts)}</pre>",
        section("Warnings", *(paragraph(sentence) for sentence in warnings or ("There are none.",))),
        section(
            "Walk",
            paragraph(
                "The scan from above: each dot is an image, its line the direction of the camera, red where something is "
                "wrong with it. From the shaded sector nothing was recorded: surfaces that face it are unobserved."
            ),
            _draw_walk(overlap),
        ),
        section(
            "Overlap",
            paragraph(
                f"Each pixel is a pair of scan images in the order of their names, white where geometry confirms "
                f"{MANY_MATCHES} matches or more. A dark row is an image that overlaps with no other one."
            ),
            picture(_draw_matrix(overlap), "confirmed matches of all pairs"),
            table(
                ("images", "in the largest group", "overlaps of an image, median"),
                [(len(overlap.names), int((~overlap.isolated).sum()), int(np.median(overlap.partners)))],
            ),
        ),
        section(
            "Scan images, the worst first",
            f'<div class="cards">{"".join(html for _, html in worst_first)}</div>',
        ),
    ]
    write_text(path, page(f"Capture {capture.name}", body))


def _draw_walk(overlap: ScanOverlap) -> str:
    """Draw the cameras in a top view as SVG; return a sentence if there are too few."""
    names = list(overlap.Ts_recon_cam)
    if len(names) < MIN_WALK:
        return paragraph(overlap.describe_walk())
    walk = describe_walk(list(overlap.Ts_recon_cam.values()))
    radius = float(np.hypot(*walk.positions[:, :2].T).max())
    # The rows of an image increase downwards, whereas the forward direction of the plan is up.
    to_px = np.array([1.0, -1.0]) * PLAN_PX / (2 * PLAN_MARGIN * radius)
    dots, ends = (
        walk.positions[:, :2] * to_px,
        (walk.positions + 0.15 * radius * walk.directions)[:, :2] * to_px,
    )
    gap_rad, before, _ = walk.find_gap()
    sector = walk.azimuths[before] + np.linspace(0, gap_rad, SECTOR_POINTS)
    rim = np.stack([np.cos(sector), np.sin(sector)], 1) * to_px * radius
    outline = " ".join(f"{x:.1f},{y:.1f}" for x, y in [(0.0, 0.0), *rim.tolist()])
    half = PLAN_PX // 2
    parts = [
        f'<svg viewBox="{-half} {-half} {PLAN_PX} {PLAN_PX}" style="max-width:{PLAN_PX}px" role="img" '
        f'aria-label="cameras from above"><polygon points="{outline}" class="span"/>'
    ]
    bad = {name for which in overlap.problems.values() for name in np.array(overlap.names)[which].tolist()}
    for name, (x, y), (u, v) in zip(names, dots.tolist(), ends.tolist(), strict=True):
        color = "#b3261e" if name in bad else "#1f6f8b"
        parts.append(
            f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{u:.1f}" y2="{v:.1f}" stroke="{color}"/>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{color}"><title>{text(name)}</title></circle>'
        )
    return f"{''.join(parts)}</svg>{paragraph(overlap.describe_walk())}"


def _draw_card(
    capture: Recording, overlap: ScanOverlap, index: int, blurred: float
) -> tuple[tuple[int, float], str]:
    """Return the rank of an image (number of problems, then blur) and its HTML."""
    name, source = overlap.names[index], capture.scan_images[index]
    partners, exposure = overlap.partners[index], overlap.exposures_ev[index]
    problems = [kind for kind, which in overlap.problems.items() if which[index]]
    problems += ["blurred"] if blurred > BLURRED else []
    prompts = [prompt for prompt in capture.prompts if prompt.image == name]
    image = jpeg_url(_draw_prompts(read_image(source), prompts), 85)
    verdict = f'<span class="poor">{text(", ".join(problems))}</span>' if problems else "fine"
    marked = f"; marked: {', '.join(sorted({prompt.part for prompt in prompts}))}" if prompts else ""
    html = (
        f'<figure class="card"><img src="{image}" alt="{text(name)}"><figcaption><b>{text(name)}</b> {verdict}<br>'
        f'<span class="dim">blur {blurred:.2f}, overlaps with {partners}, exposure {exposure:+.2f} EV{text(marked)}</span>'
        "</figcaption></figure>"
    )
    return (len(problems), blurred), html


def _draw_prompts(image: NDArray[np.uint8], prompts: Sequence[Prompt]) -> NDArray[np.uint8]:
    """Draw a thumbnail with boxes and points."""
    height, width = image.shape[:2]
    scale = THUMBNAIL_PX / width
    canvas = Image.fromarray(resize(image, THUMBNAIL_PX, round(scale * height)))
    pen = ImageDraw.Draw(canvas)
    for prompt in prompts:
        color = COLORS[prompt.part]
        if len(prompt.box):
            pen.rectangle([scale * value for value in prompt.box.tolist()], outline=color, width=2)
        for x, y, on in (prompt.points * [scale, scale, 1]).tolist():
            pen.ellipse([x - 3, y - 3, x + 3, y + 3], fill=color if on else None, outline=(255, 255, 255))
    return np.asarray(canvas)


def _draw_matrix(overlap: ScanOverlap) -> NDArray[np.uint8]:
    """Draw the confirmed matches of all pairs as gray levels (H, W, 3)."""
    grey = np.clip(255 * overlap.matches / MANY_MATCHES, 0, 255).astype(np.uint8)
    factor = max(1, MATRIX_PX // len(grey))
    return np.repeat(np.kron(grey, np.ones((factor, factor), np.uint8))[..., None], 3, axis=2)
