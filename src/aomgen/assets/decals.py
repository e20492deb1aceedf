"""Printed surfaces of made assets: stickers, screens, keyboards, tread plate, oven knobs."""

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

from aomgen.assets.textures import WORDS, Texture, noise, tint

KEY_ROWS = ("`1234567890-=", "QWERTYUIOP[]", "ASDFGHJKL;'", "ZXCVBNM,./")


def tread_plate(rng: np.random.Generator, color_srgb: ArrayLike, size: int = 512) -> Texture:
    """Pressed sheet with crossed bars in two directions, worn unevenly."""
    v, u = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    pitch = 32
    column, row = u // pitch, v // pitch
    x, y = u % pitch - pitch / 2 + 0.5, v % pitch - pitch / 2 + 0.5
    slant = np.where((column + row) % 2 == 0, 1.0, -1.0)
    along, across = (x + slant * y) / np.sqrt(2), (x - slant * y) / np.sqrt(2)
    bar = np.clip(1.3 - np.hypot(along / 13.0, across / 4.5), -0.4, 0.4)
    worn = noise(rng, size, 30) + 0.4 * noise(rng, size, 3)
    return tint(color_srgb, 0.22 * bar + 0.05 * worn + 0.03 * noise(rng, size, 0.8))


def stickers(
    rng: np.random.Generator, color_srgb: ArrayLike, width: int = 448, height: int = 320, count: int = 7
) -> Texture:
    """A grained surface with stickers of several shapes, colors and words, no two alike.

    Args:
        color_srgb: Of the surface between them (3,), 0..1.
        count: How many; each has a cell of its own, so that none hides another.
    """
    size = max(width, height)
    ground = tint(color_srgb, 0.03 * noise(rng, size, 0.8) + 0.03 * noise(rng, size, 20))
    image = Image.fromarray(ground[:height, :width])
    draw = ImageDraw.Draw(image)
    columns = int(np.ceil(np.sqrt(count * width / height)))
    rows = int(np.ceil(count / columns))
    for index in rng.permutation(columns * rows)[:count]:
        cell = np.array([width / columns, height / rows])
        half = 0.5 * cell * rng.uniform(0.62, 0.92, 2)
        middle = (np.array([index % columns, index // columns]) + 0.5) * cell
        middle += rng.uniform(-1, 1, 2) * (cell / 2 - half)
        _sticker(draw, rng, middle, half)
    return np.asarray(image)


def screen(rng: np.random.Generator, width: int = 480, height: int = 300) -> Texture:
    """A lit display: hills under a sky, two windows with text, a bar of icons."""
    sky, hill = rng.uniform(0.25, 0.75, 3), rng.uniform(0.1, 0.5, 3)
    share = np.linspace(0, 1, height)[:, None, None]
    picture = np.broadcast_to((1 - share) * sky + share * (0.5 + 0.5 * sky), (height, width, 3)).copy()
    columns = np.arange(width) / width
    for layer in range(3):
        phase = rng.uniform(0, 2 * np.pi, 2)
        line = (
            0.45
            + 0.15 * layer
            + 0.06 * np.sin(5 * columns + phase[0])
            + 0.03 * np.sin(13 * columns + phase[1])
        )
        picture[np.arange(height)[:, None] / height > line] = hill * (1.0 - 0.22 * layer)
    image = Image.fromarray(np.round(255 * picture).astype(np.uint8))
    draw = ImageDraw.Draw(image)
    for left in (0.06, 0.53):
        x0, y0 = int((left + rng.uniform(0, 0.05)) * width), int(rng.uniform(0.08, 0.2) * height)
        x1, y1 = x0 + int(0.38 * width), y0 + int(rng.uniform(0.45, 0.6) * height)
        draw.rectangle((x0, y0, x1, y1), fill=(243, 243, 240), outline=(60, 60, 60))
        draw.rectangle((x0, y0, x1, y0 + 14), fill=_ink(rng))
        for y in range(y0 + 22, y1 - 10, 12):
            draw.text((x0 + 6, y), _words(rng, 3), fill=(40, 40, 50), font=ImageFont.load_default(10))
    for icon in range(9):
        x = width * (0.2 + 0.068 * icon)
        draw.rounded_rectangle((x, height - 26, x + 20, height - 6), 4, fill=_ink(rng))
    return np.asarray(image)


def keyboard(rng: np.random.Generator, color_srgb: ArrayLike, width: int = 512, height: int = 352) -> Texture:
    """Upper side of a laptop's base: keys, touch pad, a sticker in a corner; upright for its user."""
    ground = tint(color_srgb, 0.03 * noise(rng, width, 0.8) + 0.02 * noise(rng, width, 18))
    image = Image.fromarray(ground[:height])
    draw = ImageDraw.Draw(image)
    dark = float(np.mean(color_srgb_list(color_srgb))) > 0.4
    key, ink = ((32, 32, 36), (225, 225, 225)) if dark else ((205, 205, 205), (25, 25, 30))
    left, top = 0.05 * width, 0.07 * height
    pitch = 0.9 * width / 13.5
    for row, letters in enumerate(KEY_ROWS):
        for column, letter in enumerate(letters):
            x, y = left + (column + 0.4 * row) * pitch, top + row * 0.8 * pitch
            draw.rounded_rectangle((x, y, x + pitch - 4, y + 0.8 * pitch - 4), 3, fill=key)
            draw.text((x + 7, y + 4), letter, fill=ink, font=ImageFont.load_default(13))
    y = top + 4 * 0.8 * pitch
    for start, length in ((0, 1.4), (1.5, 1.4), (3.1, 6.2), (9.4, 1.4), (10.9, 2.5)):
        x = left + start * pitch
        draw.rounded_rectangle((x, y, x + length * pitch - 4, y + 0.8 * pitch - 4), 3, fill=key)
    pad = (0.34 * width, y + 1.0 * pitch, 0.66 * width, 0.96 * height)
    draw.rounded_rectangle(pad, 6, fill=tuple(int(200 * c) for c in color_srgb_list(color_srgb)), outline=key)
    _sticker(draw, rng, np.array([0.84 * width, 0.85 * height]), np.array([0.11 * width, 0.08 * height]))
    return np.asarray(image)


def knobs(rng: np.random.Generator, color_srgb: ArrayLike, width: int = 512, height: int = 96) -> Texture:
    """Control strip of an oven: three dials with their scales, a clock, a name."""
    image = Image.new("RGB", (width, height), tuple(int(255 * c) for c in color_srgb_list(color_srgb)))
    draw = ImageDraw.Draw(image)
    ink = (235, 235, 230) if float(np.mean(color_srgb_list(color_srgb))) < 0.5 else (30, 30, 34)
    for number in range(3):
        x, y, radius = width * (0.10 + 0.15 * number), height * 0.5, 0.27 * height
        for mark in range(9):
            angle = np.deg2rad(135 + 33.75 * mark)
            dx, dy = np.cos(angle), np.sin(angle)
            inner, outer = radius * 1.2, radius * 1.5
            draw.line((x + inner * dx, y + inner * dy, x + outer * dx, y + outer * dy), fill=ink, width=2)
        draw.ellipse(
            (x - radius, y - radius, x + radius, y + radius), fill=(90, 90, 94), outline=ink, width=2
        )
        angle = rng.uniform(0, 2 * np.pi)
        draw.line(
            (x, y, x + radius * np.cos(angle), y + radius * np.sin(angle)), fill=(250, 250, 250), width=4
        )
    draw.rectangle((0.55 * width, 0.25 * height, 0.73 * width, 0.75 * height), fill=(8, 10, 12))
    clock = f"{rng.integers(1, 24)}:{rng.integers(0, 60):02d}"
    font = ImageFont.load_default(34)
    draw.text((0.64 * width, 0.5 * height), clock, fill=(250, 120, 60), font=font, anchor="mm")
    draw.text((0.87 * width, 0.5 * height), str(rng.choice(WORDS)), fill=ink, font=font, anchor="mm")
    return np.asarray(image)


def color_srgb_list(color_srgb: ArrayLike) -> list[float]:
    """A color (3,) as plain numbers."""
    return [float(c) for c in np.asarray(color_srgb, np.float64)]


def _sticker(draw: ImageDraw.ImageDraw, rng: np.random.Generator, middle: ArrayLike, half: ArrayLike) -> None:
    (x, y), (a, b) = np.asarray(middle, np.float64), np.asarray(half, np.float64)
    box = (float(x - a), float(y - b), float(x + a), float(y + b))
    fill, ink = _ink(rng), _ink(rng)
    kind = rng.integers(3)
    if kind == 0:
        draw.ellipse(box, fill=fill, outline=ink, width=4)
    elif kind == 1:
        draw.rounded_rectangle(box, 10, fill=fill, outline=(240, 240, 240), width=3)
    else:
        turn = rng.uniform(0, 2 * np.pi)
        angles = turn + np.arange(6) * np.pi / 3
        radii = np.where(np.arange(6) % 2 == 0, 1.0, 0.75)
        draw.polygon(
            [(x + a * r * np.cos(t), y + b * r * np.sin(t)) for t, r in zip(angles, radii, strict=True)],
            fill=fill,
        )
    for _ in range(4):
        dx, dy = rng.uniform(-0.5, 0.5, 2) * (a, b)
        r = rng.uniform(0.08, 0.2) * min(a, b)
        draw.ellipse((x + dx - r, y + dy - r, x + dx + r, y + dy + r), fill=_ink(rng))
    size = int(np.clip(0.5 * b, 9, 30))
    draw.text((x, y), str(rng.choice(WORDS)), fill=ink, font=ImageFont.load_default(size), anchor="mm")


def _ink(rng: np.random.Generator) -> tuple[int, int, int]:
    r, g, b = (int(c) for c in rng.integers(15, 245, 3))
    return r, g, b


def _words(rng: np.random.Generator, count: int) -> str:
    return " ".join(f"{rng.choice(WORDS)} {rng.integers(10, 99)}" for _ in range(count))
