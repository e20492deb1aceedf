"""Procedural surfaces of made assets: wood, brushed metal, plastic, enamel, glass; and the usual colors."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.values import Array

Texture = NDArray[np.uint8]

# Usual colors, sRGB 0..1.
COLORS: Final = {
    # Oak, walnut, mahogany, maple.
    "wood": ((0.76, 0.60, 0.42), (0.58, 0.40, 0.26), (0.42, 0.28, 0.20), (0.83, 0.74, 0.60)),
    # White, blue, green, red.
    "paint": ((0.86, 0.85, 0.82), (0.34, 0.45, 0.52), (0.52, 0.58, 0.44), (0.70, 0.34, 0.26)),
    # Stained wood and black lacquer.
    "dark": ((0.13, 0.11, 0.10), (0.15, 0.16, 0.18), (0.21, 0.14, 0.10)),
    # Steel, brass, black.
    "metal": ((0.76, 0.76, 0.78), (0.72, 0.60, 0.36), (0.22, 0.22, 0.23)),
}


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
