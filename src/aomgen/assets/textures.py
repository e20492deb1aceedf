"""Procedural surface prints for made assets: wood, brushed metal, plastic, glass, keypads, labels."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from aomgen.core.values import Array

Texture = NDArray[np.uint8]

WORDS = ("Orlo", "Vesta", "Kanto", "Milla", "Norden", "Tavi", "Brisk", "Ondea", "Halden", "Pelto")


def noise(rng: np.random.Generator, size: int, sigma: float | tuple[float, float]) -> Array:
    """Smooth tileable noise (size, size) with zero mean and unit spread.

    Args:
        sigma: Blur along rows (v) and columns (u), [px].
    """
    along_v, along_u = (sigma, sigma) if isinstance(sigma, int | float) else sigma
    # In the frequency domain a wide blur costs as little as a narrow one, and tiles by itself.
    v = np.exp(-2 * (np.pi * along_v * np.fft.fftfreq(size)) ** 2)
    u = np.exp(-2 * (np.pi * along_u * np.fft.rfftfreq(size)) ** 2)
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) * v[:, None] * u
    field = np.fft.irfft2(spectrum, (size, size))
    return (field - field.mean()) / field.std()


def tint(color_srgb: ArrayLike, shade: Array) -> Texture:
    """Texture (H, W, 3) uint8: one color (0..1) brightened by `shade` (H, W), +0.1 means 10 %."""
    image = np.asarray(color_srgb, np.float64) * (1.0 + shade[..., None])
    return np.round(255 * np.clip(image, 0.0, 1.0)).astype(np.uint8)


def wood(rng: np.random.Generator, color_srgb: ArrayLike, size: int = 512) -> Texture:
    """Wood with its grain along u: warped growth rings, fibres and pores."""
    v, u = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size), indexing="ij")
    warp = 0.05 * noise(rng, size, (24, 120)) + 0.012 * noise(rng, size, (6, 60))
    distance = np.hypot(v - rng.uniform(0.2, 0.8) + warp, 0.06 * (u - rng.uniform(0, 1)))
    rings = np.sin(2 * np.pi * rng.uniform(9, 15) * distance)
    fibres = noise(rng, size, (0.6, 20.0))
    pores = -np.clip(noise(rng, size, (0.7, 6.0)) - 1.9, 0, 1)
    shade = 0.10 * np.sign(rings) * np.abs(rings) ** 0.7 + 0.05 * fibres + 0.35 * pores
    return tint(color_srgb, shade + 0.05 * noise(rng, size, 50))


def brushed_metal(rng: np.random.Generator, color_srgb: ArrayLike, size: int = 512) -> Texture:
    """Metal brushed along u, with faint smudges."""
    shade = 0.045 * noise(rng, size, (0.5, 40.0)) + 0.03 * noise(rng, size, (30, 30))
    return tint(color_srgb, shade + 0.015 * noise(rng, size, 0.7))


def plastic(rng: np.random.Generator, color_srgb: ArrayLike, size: int = 256) -> Texture:
    """Grained plastic."""
    return tint(color_srgb, 0.03 * noise(rng, size, 0.8) + 0.02 * noise(rng, size, 18))


def speckled(rng: np.random.Generator, color_srgb: ArrayLike, size: int = 512) -> Texture:
    """Enamel or laminate with dark and light speckles."""
    fine = noise(rng, size, 1.1)
    return tint(color_srgb, 0.22 * ((fine > 1.7).astype(float) - (fine < -1.6)) + 0.03 * noise(rng, size, 20))


def window(rng: np.random.Generator, size: int = 256) -> Texture:
    """Dark glass in front of a perforated screen, with a soft reflection."""
    v, u = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    dots = ((u % 6 < 3) & (v % 6 < 3)).astype(float)
    edge = np.minimum.reduce([u, v, size - 1 - u, size - 1 - v]) / (0.10 * size)
    sheen = np.clip(1 - np.abs((u + v) / size - rng.uniform(0.6, 1.4)) / 0.25, 0, 1)
    value = 0.07 + 0.05 * dots * np.clip(edge - 0.6, 0, 1) + 0.05 * sheen + 0.01 * noise(rng, size, 1.0)
    return tint((0.9, 0.95, 1.0), value - 1.0)


def keypad(rng: np.random.Generator, color_srgb: ArrayLike, width: int = 192, height: int = 448) -> Texture:
    """Control panel with a clock and twelve keys, upright when v points up."""
    base = np.asarray(color_srgb, np.float64)
    image = Image.fromarray(np.broadcast_to(np.round(255 * base).astype(np.uint8), (height, width, 3)).copy())
    draw = ImageDraw.Draw(image)
    ink = (235, 235, 230) if base.mean() < 0.5 else (30, 30, 34)
    margin, top = int(0.12 * width), int(0.06 * height)
    draw.rectangle((margin, top, width - margin, top + int(0.13 * height)), fill=(8, 12, 10))
    clock = f"{rng.integers(1, 24)}:{rng.integers(0, 60):02d}"
    draw.text((width / 2, top + 0.065 * height), clock, fill=(90, 240, 150), font=_font(40), anchor="mm")
    names = [str(i) for i in range(1, 10)] + ["C", "0", "+"]
    cell = (width - 2 * margin) / 3
    for index, name in enumerate(names):
        x, y = margin + cell * (index % 3), 0.28 * height + 0.9 * cell * (index // 3)
        box = (x + 3, y + 3, x + cell - 3, y + 0.9 * cell - 3)
        draw.rounded_rectangle(box, 5, outline=ink, width=2)
        draw.text((x + cell / 2, y + 0.45 * cell), name, fill=ink, font=_font(22), anchor="mm")
    y = 0.80 * height
    for x, fill, name in ((margin, (180, 40, 36), "STOP"), (width / 2 + 4, (40, 140, 70), "START")):
        draw.rounded_rectangle((x, y, x + width / 2 - margin - 4, y + 0.10 * height), 8, fill=fill)
        centre = (x + (width / 2 - margin) / 2, y + 0.05 * height)
        draw.text(centre, name, fill=(250, 250, 250), font=_font(18), anchor="mm")
    return np.asarray(image)


def label(rng: np.random.Generator, width: int = 320, height: int = 200) -> Texture:
    """Rating plate: name, lines of small print, a bar code."""
    paper = tuple(int(c) for c in rng.integers(215, 250, 3))
    image = Image.new("RGB", (width, height), paper)
    draw = ImageDraw.Draw(image)
    draw.rectangle((4, 4, width - 5, height - 5), outline=(40, 40, 40), width=2)
    draw.text((16, 12), f"{rng.choice(WORDS)} {rng.integers(100, 999)}", fill=(20, 20, 20), font=_font(34))
    for row in range(5):
        words = " ".join(f"{rng.choice(WORDS)}-{rng.integers(10, 99)}" for _ in range(3))
        draw.text((16, 58 + 17 * row), words, fill=(50, 50, 50), font=_font(14))
    x = 16
    while x < width - 20:
        bar = int(rng.integers(1, 5))
        draw.rectangle((x, height - 50, x + bar, height - 14), fill=(10, 10, 10))
        x += bar + int(rng.integers(2, 6))
    return np.asarray(image)


def vents(rng: np.random.Generator, color_srgb: ArrayLike, width: int = 256, height: int = 160) -> Texture:
    """Rows of ventilation slots in a painted sheet."""
    base = tuple(int(255 * c) for c in np.asarray(color_srgb, np.float64))
    image = Image.new("RGB", (width, height), base)
    draw = ImageDraw.Draw(image)
    columns, rows = int(rng.integers(8, 13)), int(rng.integers(3, 5))
    for i in range(columns):
        for j in range(rows):
            x, y = 10 + i * (width - 20) / columns, 10 + j * (height - 20) / rows
            box = (x + 2, y + 3, x + (width - 20) / columns - 5, y + (height - 20) / rows - 5)
            draw.rounded_rectangle(box, 3, fill=(22, 22, 24))
    return np.asarray(image)


def nameplate(rng: np.random.Generator, color_srgb: ArrayLike, width: int = 256, height: int = 56) -> Texture:
    """Brand name in light letters on the surface's color."""
    base = np.asarray(color_srgb, np.float64)
    image = Image.new("RGB", (width, height), tuple(int(255 * c) for c in base))
    ink = (225, 225, 225) if base.mean() < 0.5 else (35, 35, 40)
    text = str(rng.choice(WORDS)).upper()
    ImageDraw.Draw(image).text((width / 2, height / 2), text, fill=ink, font=_font(36), anchor="mm")
    return np.asarray(image)


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
