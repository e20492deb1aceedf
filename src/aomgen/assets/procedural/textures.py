"""Procedural textures of parametric assets: wood, metal, plastic, enamel, glass, and prints with words, stickers and keys.

Textures are uint8 images (H, W, 3) in sRGB; arguments `color_srgb` (3,) are in 0..1. Row 0 is the top (v = 1).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from aomgen.core.values import Array

Texture = NDArray[np.uint8]

# Fictitious names of brands and products.
WORDS = ("Orlo", "Vesta", "Kanto", "Milla", "Norden", "Tavi", "Brisk", "Ondea", "Halden", "Pelto")
KEY_ROWS = ("`1234567890-=", "QWERTYUIOP[]", "ASDFGHJKL;'", "ZXCVBNM,./")


def noise(rng: np.random.Generator, size: int, sigma: float | tuple[float, float]) -> Array:
    """Sample smooth tileable noise (size, size) with zero mean and unit standard deviation.

    Args:
        rng: Generator of the noise.
        size: Height and width, [px].
        sigma: Standard deviation of the Gaussian blur, [px]; a pair states it along v and u.
    """
    along_v, along_u = (sigma, sigma) if isinstance(sigma, int | float) else sigma
    # In the frequency domain, the cost is independent of the width of the blur, and the noise is periodic.
    v = np.exp(-2 * (np.pi * along_v * np.fft.fftfreq(size)) ** 2)
    u = np.exp(-2 * (np.pi * along_u * np.fft.rfftfreq(size)) ** 2)
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) * v[:, None] * u
    field = np.fft.irfft2(spectrum, (size, size))
    return (field - field.mean()) / field.std()


def tint(color_srgb: ArrayLike, shade: Array) -> Texture:
    """Scale one color by 1 + `shade` (H, W); return the texture (H, W, 3)."""
    image = np.asarray(color_srgb, np.float64) * (1.0 + shade[..., None])
    return np.round(255 * np.clip(image, 0.0, 1.0)).astype(np.uint8)


def wood(rng: np.random.Generator, color_srgb: ArrayLike, size: int = 512) -> Texture:
    """Synthesize wood with its grain along u: warped growth rings, fibers and pores."""
    v, u = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size), indexing="ij")
    warp = 0.05 * noise(rng, size, (24, 120)) + 0.012 * noise(rng, size, (6, 60))
    distance = np.hypot(v - rng.uniform(0.2, 0.8) + warp, 0.06 * (u - rng.uniform(0, 1)))
    rings = np.sin(2 * np.pi * rng.uniform(9, 15) * distance)
    fibres = noise(rng, size, (0.6, 20.0))
    pores = -np.clip(noise(rng, size, (0.7, 6.0)) - 1.9, 0, 1)
    shade = 0.10 * np.sign(rings) * np.abs(rings) ** 0.7 + 0.05 * fibres + 0.35 * pores
    return tint(color_srgb, shade + 0.05 * noise(rng, size, 50))


def make_brushed_metal(rng: np.random.Generator, color_srgb: ArrayLike, size: int = 512) -> Texture:
    """Synthesize metal that is brushed along u, with faint smudges."""
    shade = 0.045 * noise(rng, size, (0.5, 40.0)) + 0.03 * noise(rng, size, (30, 30))
    return tint(color_srgb, shade + 0.015 * noise(rng, size, 0.7))


def plastic(rng: np.random.Generator, color_srgb: ArrayLike, size: int = 256) -> Texture:
    """Synthesize grained plastic."""
    return tint(color_srgb, 0.03 * noise(rng, size, 0.8) + 0.02 * noise(rng, size, 18))


def make_speckles(rng: np.random.Generator, color_srgb: ArrayLike, size: int = 512) -> Texture:
    """Synthesize enamel or laminate with dark and light speckles."""
    fine = noise(rng, size, 1.1)
    return tint(color_srgb, 0.22 * ((fine > 1.7).astype(float) - (fine < -1.6)) + 0.03 * noise(rng, size, 20))


def window(rng: np.random.Generator, size: int = 256) -> Texture:
    """Synthesize dark glass in front of a perforated screen, with a soft reflection."""
    v, u = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    dots = ((u % 6 < 3) & (v % 6 < 3)).astype(float)
    edge = np.minimum.reduce([u, v, size - 1 - u, size - 1 - v]) / (0.10 * size)
    sheen = np.clip(1 - np.abs((u + v) / size - rng.uniform(0.6, 1.4)) / 0.25, 0, 1)
    value = 0.07 + 0.05 * dots * np.clip(edge - 0.6, 0, 1) + 0.05 * sheen + 0.01 * noise(rng, size, 1.0)
    return tint((0.9, 0.95, 1.0), value - 1.0)


def tread_plate(rng: np.random.Generator, color_srgb: ArrayLike) -> Texture:
    """Synthesize unevenly worn tread plate with raised bars in two directions."""
    size, pitch = 512, 32
    v, u = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
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
    """Synthesize a grained surface with stickers of random shapes, colors and words.

    Each sticker is in a separate cell of a grid, so stickers do not overlap.

    Args:
        rng: Generator of the texture.
        color_srgb: Color of the surface (3,).
        width, height: Size of the texture, [px].
        count: Number of stickers.
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


def screen(rng: np.random.Generator) -> Texture:
    """Synthesize the image of a display: a landscape, two windows with text, a bar of icons."""
    width, height = 480, 300
    sky, hill = rng.uniform(0.25, 0.75, 3), rng.uniform(0.1, 0.5, 3)
    share = np.linspace(0, 1, height)[:, None, None]
    picture = np.broadcast_to((1 - share) * sky + share * (0.5 + 0.5 * sky), (height, width, 3)).copy()
    columns = np.arange(width) / width
    for layer in range(3):
        phase = rng.uniform(0, 2 * np.pi, 2)
        waves = 0.45 + 0.15 * layer + 0.06 * np.sin(5 * columns + phase[0])
        line = waves + 0.03 * np.sin(13 * columns + phase[1])
        picture[np.arange(height)[:, None] / height > line] = hill * (1.0 - 0.22 * layer)
    image = Image.fromarray(np.round(255 * picture).astype(np.uint8))
    draw = ImageDraw.Draw(image)
    for left in (0.06, 0.53):
        x0, y0 = int((left + rng.uniform(0, 0.05)) * width), int(rng.uniform(0.08, 0.2) * height)
        x1, y1 = x0 + int(0.38 * width), y0 + int(rng.uniform(0.45, 0.6) * height)
        draw.rectangle((x0, y0, x1, y1), fill=(243, 243, 240), outline=(60, 60, 60))
        draw.rectangle((x0, y0, x1, y0 + 14), fill=draw_ink(rng))
        for y in range(y0 + 22, y1 - 10, 12):
            words = " ".join(f"{rng.choice(WORDS)} {rng.integers(10, 99)}" for _ in range(3))
            write(draw, (x0 + 6, y), words, 10, (40, 40, 50))
    for icon in range(9):
        x = width * (0.2 + 0.068 * icon)
        draw.rounded_rectangle((x, height - 26, x + 20, height - 6), 4, fill=draw_ink(rng))
    return np.asarray(image)


def keyboard(rng: np.random.Generator, color_srgb: ArrayLike) -> Texture:
    """Synthesize the top of a laptop's base: keys, touchpad and a sticker in a corner, upright for the user."""
    width, height = 512, 352
    ground = tint(color_srgb, 0.03 * noise(rng, width, 0.8) + 0.02 * noise(rng, width, 18))
    image = Image.fromarray(ground[:height])
    draw = ImageDraw.Draw(image)
    bright = np.asarray(color_srgb).mean() > 0.4
    key, ink = ((32, 32, 36), (225, 225, 225)) if bright else ((205, 205, 205), (25, 25, 30))
    left, top = 0.05 * width, 0.07 * height
    pitch = 0.9 * width / 13.5
    for row, letters in enumerate(KEY_ROWS):
        for column, letter in enumerate(letters):
            x, y = left + (column + 0.4 * row) * pitch, top + row * 0.8 * pitch
            draw.rounded_rectangle((x, y, x + pitch - 4, y + 0.8 * pitch - 4), 3, fill=key)
            write(draw, (x + 7, y + 4), letter, 13, ink)
    y = top + 4 * 0.8 * pitch
    for start, length in ((0, 1.4), (1.5, 1.4), (3.1, 6.2), (9.4, 1.4), (10.9, 2.5)):
        x = left + start * pitch
        draw.rounded_rectangle((x, y, x + length * pitch - 4, y + 0.8 * pitch - 4), 3, fill=key)
    pad = (0.34 * width, y + 1.0 * pitch, 0.66 * width, 0.96 * height)
    draw.rounded_rectangle(pad, 6, fill=_to_pixel(color_srgb, 200), outline=key)
    _sticker(draw, rng, np.array([0.84 * width, 0.85 * height]), np.array([0.11 * width, 0.08 * height]))
    return np.asarray(image)


def keypad(rng: np.random.Generator, color_srgb: ArrayLike) -> Texture:
    """Synthesize a tall control panel with a clock and twelve keys."""
    width, height = 192, 448
    image = Image.new("RGB", (width, height), _to_pixel(np.round(255 * np.asarray(color_srgb)), 1))
    draw = ImageDraw.Draw(image)
    ink = (235, 235, 230) if np.asarray(color_srgb).mean() < 0.5 else (30, 30, 34)
    margin, top = int(0.12 * width), int(0.06 * height)
    draw.rectangle((margin, top, width - margin, top + int(0.13 * height)), fill=(8, 12, 10))
    clock = f"{rng.integers(1, 24)}:{rng.integers(0, 60):02d}"
    write(draw, (width / 2, top + 0.065 * height), clock, 40, (90, 240, 150), "mm")
    names = [str(i) for i in range(1, 10)] + ["C", "0", "+"]
    cell = (width - 2 * margin) / 3
    for index, name in enumerate(names):
        x, y = margin + cell * (index % 3), 0.28 * height + 0.9 * cell * (index // 3)
        box = (x + 3, y + 3, x + cell - 3, y + 0.9 * cell - 3)
        draw.rounded_rectangle(box, 5, outline=ink, width=2)
        write(draw, (x + cell / 2, y + 0.45 * cell), name, 22, ink, "mm")
    y = 0.80 * height
    for x, fill, name in ((margin, (180, 40, 36), "STOP"), (width / 2 + 4, (40, 140, 70), "START")):
        draw.rounded_rectangle((x, y, x + width / 2 - margin - 4, y + 0.10 * height), 8, fill=fill)
        centre = (x + (width / 2 - margin) / 2, y + 0.05 * height)
        write(draw, centre, name, 18, (250, 250, 250), "mm")
    return np.asarray(image)


def key_strip(rng: np.random.Generator, color_srgb: ArrayLike) -> Texture:
    """Synthesize a wide control panel with a brand name, a clock and two rows of keys."""
    width, height = 640, 96
    image = Image.new("RGB", (width, height), _to_pixel(color_srgb))
    draw = ImageDraw.Draw(image)
    ink = (235, 235, 230) if np.asarray(color_srgb).mean() < 0.5 else (30, 30, 34)
    write(draw, (90, height / 2), str(rng.choice(WORDS)).upper(), 34, ink, "mm")
    draw.rectangle((180, 16, 320, height - 16), fill=(8, 12, 10))
    clock = f"{rng.integers(1, 24)}:{rng.integers(0, 60):02d}"
    write(draw, (250, height / 2), clock, 44, (90, 240, 150), "mm")
    for index, name in enumerate("12345+67890-"):
        x, y = 344 + 46 * (index % 6), 12 + 38 * (index // 6)
        draw.rounded_rectangle((x, y, x + 40, y + 32), 5, outline=ink, width=2)
        write(draw, (x + 20, y + 16), name, 20, ink, "mm")
    return np.asarray(image)


def label(rng: np.random.Generator) -> Texture:
    """Synthesize a rating plate with a name, lines of small print and a bar code."""
    width, height = 320, 200
    image = Image.new("RGB", (width, height), _to_pixel(rng.integers(215, 250, 3), 1))
    draw = ImageDraw.Draw(image)
    draw.rectangle((4, 4, width - 5, height - 5), outline=(40, 40, 40), width=2)
    write(draw, (16, 12), f"{rng.choice(WORDS)} {rng.integers(100, 999)}", 34, (20, 20, 20))
    for row in range(5):
        words = " ".join(f"{rng.choice(WORDS)}-{rng.integers(10, 99)}" for _ in range(3))
        write(draw, (16, 58 + 17 * row), words, 14, (50, 50, 50))
    bar_code(draw, rng, (16, width - 20), (height - 50, height - 14), 6)
    return np.asarray(image)


def vents(rng: np.random.Generator, color_srgb: ArrayLike) -> Texture:
    """Synthesize rows of ventilation slots in a colored sheet."""
    width, height = 256, 160
    image = Image.new("RGB", (width, height), _to_pixel(color_srgb))
    draw = ImageDraw.Draw(image)
    columns, rows = int(rng.integers(8, 13)), int(rng.integers(3, 5))
    for i in range(columns):
        for j in range(rows):
            x, y = 10 + i * (width - 20) / columns, 10 + j * (height - 20) / rows
            box = (x + 2, y + 3, x + (width - 20) / columns - 5, y + (height - 20) / rows - 5)
            draw.rounded_rectangle(box, 3, fill=(22, 22, 24))
    return np.asarray(image)


def nameplate(rng: np.random.Generator, color_srgb: ArrayLike, height: int = 56) -> Texture:
    """Synthesize a nameplate with a brand name in light or dark letters on the color of the surface."""
    image = Image.new("RGB", (256, height), _to_pixel(color_srgb))
    ink = (225, 225, 225) if np.asarray(color_srgb).mean() < 0.5 else (35, 35, 40)
    write(ImageDraw.Draw(image), (128, height / 2), str(rng.choice(WORDS)).upper(), 36, ink, "mm")
    return np.asarray(image)


def write(
    draw: ImageDraw.ImageDraw,
    place: tuple[float, float],
    words: str,
    size: int,
    ink: tuple[int, ...],
    anchor: str | None = None,
) -> None:
    """Write words at a location, [px], with a font size and color; `anchor` is Pillow's text anchor."""
    draw.text(place, words, fill=ink, font=ImageFont.load_default(size), anchor=anchor)


def bar_code(
    draw: ImageDraw.ImageDraw, rng: np.random.Generator, x: tuple[int, int], y: tuple[int, int], gap: int
) -> None:
    """Draw the bars of a bar code between two columns `x` and two rows `y`, with gaps below `gap`, [px]."""
    left = x[0]
    while left < x[1]:
        width = int(rng.integers(1, 5))
        draw.rectangle((left, y[0], left + width, y[1]), fill=(10, 10, 10))
        left += width + int(rng.integers(2, gap))


def draw_ink(rng: np.random.Generator) -> tuple[int, int, int]:
    """Sample a color, 0..255."""
    r, g, b = (int(c) for c in rng.integers(15, 245, 3))
    return r, g, b


def _to_pixel(color_srgb: ArrayLike, scale: int = 255) -> tuple[int, ...]:
    return tuple(int(scale * c) for c in np.asarray(color_srgb, np.float64).tolist())


def _sticker(draw: ImageDraw.ImageDraw, rng: np.random.Generator, middle: ArrayLike, half: ArrayLike) -> None:
    (x, y), (a, b) = np.asarray(middle, np.float64), np.asarray(half, np.float64)
    box = (float(x - a), float(y - b), float(x + a), float(y + b))
    fill, ink = draw_ink(rng), draw_ink(rng)
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
        draw.ellipse((x + dx - r, y + dy - r, x + dx + r, y + dy + r), fill=draw_ink(rng))
    write(draw, (x, y), str(rng.choice(WORDS)), int(np.clip(0.5 * b, 9, 30)), ink, "mm")
