"""Printed paper for synthetic rooms: posters, cartons and book covers, rich in corners."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from aomgen.assets.procedural.builder import pick_color
from aomgen.assets.procedural.textures import WORDS, Texture, bar_code, draw_ink, noise, tint, wood, write


def poster(rng: np.random.Generator, width: int = 384, height: int = 512) -> Texture:
    """Abstract poster: shapes of many sizes over smooth colors, a title and small print."""
    image = Image.fromarray(_smooth_colors(rng, width, height))
    draw = ImageDraw.Draw(image)
    for size in np.geomspace(0.35, 0.03, 46) * width:
        x, y = rng.uniform(0, width), rng.uniform(0, 0.85 * height)
        a, b = size * rng.uniform(0.4, 1.0, 2)
        color = draw_ink(rng)
        kind = rng.integers(4)
        if kind == 0:
            draw.ellipse((x - a, y - b, x + a, y + b), fill=color, outline=draw_ink(rng), width=2)
        elif kind == 1:
            draw.rectangle((x - a, y - b, x + a, y + b), fill=color)
        elif kind == 2:
            corners = [(x + float(dx), y + float(dy)) for dx, dy in rng.uniform(-size, size, (3, 2))]
            draw.polygon(corners, fill=color)
        else:
            draw.line((x - a, y - b, x + a, y + b), fill=color, width=int(rng.integers(2, 7)))
    draw.rectangle((0, int(0.86 * height), width, height), fill=(238, 234, 226))
    title = f"{rng.choice(WORDS)} {rng.choice(WORDS)}"
    write(draw, (14, 0.875 * height), title, int(0.055 * height), (25, 25, 30))
    for row in range(2):
        _small_print(draw, rng, 14, int((0.94 + 0.025 * row) * height), 9)
    return np.asarray(image)


def carton(rng: np.random.Generator, width: int = 320, height: int = 240) -> Texture:
    """One face of a cardboard box: print, tape, arrows, a bar code."""
    paper = tint(rng.uniform(0.8, 1.1) * np.array([0.70, 0.52, 0.34]), 0.05 * noise(rng, 512, (0.6, 8)))
    image = Image.fromarray(paper[:height, :width])
    draw = ImageDraw.Draw(image)
    ink = tuple(int(c) for c in rng.integers(10, 90, 3))
    if rng.random() < 0.6:
        y = int(rng.uniform(0.35, 0.6) * height)
        draw.rectangle((0, y, width, y + 26), fill=tuple(int(c) for c in rng.integers(150, 230, 3)))
    label_x, label_y = int(rng.uniform(0.05, 0.4) * width), int(rng.uniform(0.05, 0.4) * height)
    draw.rectangle(
        (label_x, label_y, label_x + 150, label_y + 92), fill=(240, 240, 236), outline=(60, 60, 60)
    )
    for row in range(4):
        _small_print(draw, rng, label_x + 8, label_y + 8 + 15 * row, 12)
    bar_code(draw, rng, (label_x + 8, label_x + 138), (label_y + 70, label_y + 88), 5)
    name = f"{rng.choice(WORDS).upper()} {rng.integers(10, 99)}"
    at = (rng.uniform(0.05, 0.4) * width, rng.uniform(0.66, 0.8) * height)
    write(draw, at, name, int(rng.integers(26, 44)), ink)
    for _ in range(int(rng.integers(1, 4))):
        x, y = rng.uniform(0.6, 0.9) * width, rng.uniform(0.15, 0.7) * height
        draw.polygon(
            [(x, y - 20), (x + 16, y), (x + 6, y), (x + 6, y + 24), (x - 6, y + 24), (x - 6, y), (x - 16, y)],
            fill=ink,
        )
    return np.asarray(image)


def table_top(rng: np.random.Generator, size: int = 1024) -> Texture:
    """Wood of edge-glued staves, each with its own shade."""
    color = np.array([(0.72, 0.52, 0.34), (0.62, 0.44, 0.30), (0.78, 0.64, 0.46)][rng.integers(3)])
    image = wood(rng, color, size).astype(np.float64)
    edges = np.cumsum(rng.integers(50, 90, 40))
    for low, high in zip([0, *edges], edges, strict=False):
        start = 0
        while start < size and low < size:
            end = start + int(rng.integers(250, 600))
            image[low:high, start:end] *= rng.uniform(0.84, 1.12)
            image[low:high, start : start + 2] *= 0.75
            start = end
        image[low : low + 2] *= 0.8
    fine = noise(rng, size, 1.2)
    image *= 1.0 - 0.25 * (fine > 2.1)[..., None]
    return np.clip(image, 0, 255).astype(np.uint8)


def striped(rng: np.random.Generator, size: int = 768) -> Texture:
    """A woven mat: stripes of several widths in three colors, again and again."""
    # Dyed wool is duller than paint.
    colors = rng.uniform(0.2, 0.85, (3, 1)) + rng.uniform(-0.15, 0.15, (3, 3))
    widths = rng.integers(8, 34, 6)
    repeat = np.repeat(np.arange(6) % 3, widths)
    row = colors[np.resize(repeat, size)]
    weave = 0.05 * noise(rng, size, (0.6, 2.5)) + 0.04 * noise(rng, size, 40)
    image = np.broadcast_to(row[:, None] if rng.random() < 0.5 else row[None], (size, size, 3))
    return np.round(255 * np.clip(image * (1.0 + weave[..., None]), 0, 1)).astype(np.uint8)


def checked(rng: np.random.Generator, size: int = 768) -> Texture:
    """A checked cloth: bands of one color across bands of another on a light ground."""
    ground, one, other = rng.uniform(0.75, 0.95), rng.uniform(0.1, 0.6, 3), rng.uniform(0.1, 0.6, 3)
    pitch = int(rng.integers(24, 56))
    band = (np.arange(size) // pitch % 2).astype(float)[:, None, None]
    image = ground * (1 - 0.5 * band) + 0.5 * band * one
    across = band.transpose(1, 0, 2)
    image = image * (1 - 0.5 * across) + 0.5 * across * other
    weave = 0.04 * noise(rng, size, 0.8) + 0.05 * noise(rng, size, 40)
    return np.round(255 * np.clip(image * (1.0 + weave[..., None]), 0, 1)).astype(np.uint8)


def planks(rng: np.random.Generator, size: int = 768) -> Texture:
    """A wooden board of another shade than the table's."""
    return wood(rng, pick_color(rng, "wood"), size)


def tiles(rng: np.random.Generator, size: int = 1024, count: int = 6) -> Texture:
    """Floor tiles of stone with joints."""
    image = tint((0.52, 0.51, 0.50), 0.06 * noise(rng, size, (3, 14)) + 0.05 * noise(rng, size, 1.0)).astype(
        float
    )
    edge = size // count
    for i in range(count):
        for j in range(count):
            image[i * edge : (i + 1) * edge, j * edge : (j + 1) * edge] *= rng.uniform(0.8, 1.15)
    image[np.arange(size) % edge < 4] = 90
    image[:, np.arange(size) % edge < 4] = 90
    return np.clip(image, 0, 255).astype(np.uint8)


def plaster(rng: np.random.Generator, size: int = 1024) -> Texture:
    """Rough wall paint with stains."""
    color = rng.uniform(0.55, 0.8) * np.array([1.0, rng.uniform(0.94, 1.0), rng.uniform(0.86, 1.0)])
    shade = 0.05 * noise(rng, size, 1.2) + 0.06 * noise(rng, size, 12) + 0.05 * noise(rng, size, 70)
    spots = noise(rng, size, 2.5)
    return tint(color, shade - 0.18 * (spots > 2.3))


def _smooth_colors(rng: np.random.Generator, width: int, height: int) -> NDArray[np.uint8]:
    small = rng.integers(30, 235, (4, 3, 3)).astype(np.uint8)
    return np.asarray(Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC))


def _small_print(draw: ImageDraw.ImageDraw, rng: np.random.Generator, x: int, y: int, size: int) -> None:
    words = " ".join(f"{rng.choice(WORDS)} {rng.integers(10, 999)}" for _ in range(3))
    write(draw, (x, y), words[:22], size, (45, 45, 50))
