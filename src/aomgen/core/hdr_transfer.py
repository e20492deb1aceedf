"""High dynamic range video signals (HLG, PQ) as sRGB images."""

from functools import cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

Transfer = Literal["HLG", "PQ"]
# Constants of the hybrid log-gamma curve, BT.2100-2, table 5.
_A: Final = 0.17883277
_B: Final = 1 - 4 * _A
_C: Final = 0.5 - _A * np.log(4 * _A)
# Peak luminance of the reference display of HLG and of PQ, and its exponent for HLG, [cd/m^2] and [1].
_HLG_PEAK, _PQ_PEAK, _HLG_GAMMA = 1000.0, 10_000.0, 1.2
# Luminance of a white page in both, BT.2408-7, [cd/m^2]; it becomes the white of the image.
_WHITE: Final = 203.0
# Constants of the perceptual quantizer, BT.2100-2, table 4.
_M1, _M2 = 2610 / 16384, 2523 / 4096 * 128
# Constants of the same curve, continued.
_C1, _C2, _C3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
# Luminance of the BT.2020 primaries.
_LUMA_2020: Final = np.array([0.2627, 0.6780, 0.0593])
# Their conversion to those of sRGB, BT.2087-0.
_SRGB_FROM_2020: Final = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
)
# Linear values below this stay as they are; brighter ones approach 1 smoothly.
_KNEE: Final = 0.75


@cache
def _light_of_levels(transfer: Transfer) -> NDArray[np.float32]:
    """Light (65536,) of each level: of HLG the scene's, as a share of its peak, of PQ the display's, white = 1."""
    levels = np.arange(65536) / 65535
    if transfer == "HLG":
        light = np.where(levels <= 0.5, levels**2 / 3, (np.exp((levels - _C) / _A) + _B) / 12)
    else:
        root = levels ** (1 / _M2)
        light = _PQ_PEAK / _WHITE * (np.maximum(root - _C1, 0) / (_C2 - _C3 * root)) ** (1 / _M1)
    return light.astype(np.float32)


def tone_map(signal: NDArray[np.uint16], transfer: Transfer) -> NDArray[np.uint8]:
    """Convert a BT.2020 signal of high dynamic range to an sRGB image.

    A white page (203 cd/m^2) becomes nearly white; highlights above it are compressed, with their hue kept.

    Args:
        signal: Non-linear R'G'B' (H, W, 3), full range, 0..65535.

    Returns:
        sRGB image (H, W, 3).

    Source: ITU-R BT.2100-2 (curves), BT.2087-0 (primaries), BT.2408-7 (white).
    """
    light = _light_of_levels(transfer)[signal]
    if transfer == "HLG":
        luminance = np.maximum(light @ _LUMA_2020.astype(np.float32), 1e-6)
        light *= (_HLG_PEAK / _WHITE * luminance ** (_HLG_GAMMA - 1))[..., None]
    linear = np.maximum(light @ _SRGB_FROM_2020.T.astype(np.float32), 0)
    brightest = np.maximum(linear.max(-1, keepdims=True), 1e-6)
    compressed = 1 - (1 - _KNEE) * np.exp(-(brightest - _KNEE) / (1 - _KNEE))
    linear *= np.where(brightest > _KNEE, compressed / brightest, 1)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255 * srgb).clip(0, 255).astype(np.uint8)
