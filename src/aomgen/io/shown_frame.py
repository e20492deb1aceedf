"""Conversion of decoded video frames for display: upright, with square pixels, in the dynamic range of sRGB."""

from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Final, Literal

import numpy as np
from av import VideoFrame
from av.sidedata.sidedata import Type
from av.video.stream import VideoStream
from numpy.typing import NDArray

from aomgen.conventions import srgb_from_linear
from aomgen.errors import MalformedFileError

Transfer = Literal["HLG", "PQ"]
# Transfer functions by their code in ITU-T H.273.
_TRANSFERS: Final[dict[int, Transfer]] = {16: "PQ", 18: "HLG"}
# Unit of the entries of a display matrix.
_ONE: Final = 1 << 16
# Pixels whose aspect ratio differs from 1 by at most this count as square.
_SQUARE: Final = 0.002
# Constants of the hybrid log-gamma curve, BT.2100-2, table 5.
_A: Final = 0.17883277
_B: Final = 1 - 4 * _A
_C: Final = 0.5 - _A * np.log(4 * _A)
# Peak luminance, [cd/m^2], of the reference displays of HLG and PQ, and system gamma of HLG.
_HLG_PEAK, _PQ_PEAK, _HLG_GAMMA = 1000.0, 10_000.0, 1.2
# Luminance of diffuse white in HLG and PQ, BT.2408-7, [cd/m^2]; it corresponds to linear 1 of the sRGB image.
_WHITE: Final = 203.0
# Exponents of the perceptual quantizer, BT.2100-2, table 4.
_M1, _M2 = 2610 / 16384, 2523 / 4096 * 128
# Coefficients of the perceptual quantizer.
_C1, _C2, _C3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
# Luminance coefficients of the BT.2020 primaries.
_LUMA_2020: Final = np.array([0.2627, 0.6780, 0.0593])
# Conversion of linear values from BT.2020 to sRGB primaries, BT.2087-0.
_SRGB_FROM_2020: Final = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
)
# Linear values up to this remain unchanged; higher ones are compressed smoothly below 1.
_KNEE: Final = 0.75


@cache
def _light_of_levels(transfer: Transfer) -> NDArray[np.float32]:
    """Compute the linear value (65536,) of each 16-bit level.

    For HLG this is scene light relative to its peak, for PQ display light relative to diffuse white.
    """
    levels = np.arange(65536) / 65535
    if transfer == "HLG":
        light = np.where(levels <= 0.5, levels**2 / 3, (np.exp((levels - _C) / _A) + _B) / 12)
    else:
        root = levels ** (1 / _M2)
        light = _PQ_PEAK / _WHITE * (np.maximum(root - _C1, 0) / (_C2 - _C3 * root)) ** (1 / _M1)
    return light.astype(np.float32)


def tone_map(signal: NDArray[np.uint16], transfer: Transfer) -> NDArray[np.uint8]:
    """Convert a BT.2020 signal of high dynamic range to an sRGB image.

    Diffuse white (203 cd/m^2) becomes nearly white; brighter highlights are compressed with their hue preserved.

    Args:
        signal: Non-linear R'G'B' (H, W, 3), full range, 0..65535.
        transfer: Transfer function of the signal.

    Returns:
        sRGB image (H, W, 3) uint8.

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
    return np.round(255 * srgb_from_linear(linear)).clip(0, 255).astype(np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameDisplay:
    """Conversion of the stored frames of a stream to displayed frames.

    Attributes:
        transposed: Whether rows and columns are exchanged, before they are reversed.
        mirrored: Whether the order of the columns, and that of the rows, is reversed.
        aspect: Ratio of width to height of a stored pixel.
        transfer: Transfer function of a signal of high dynamic range; None for standard range.
    """

    transposed: bool
    mirrored: tuple[bool, bool]
    aspect: Fraction
    transfer: Transfer | None

    @property
    def turned(self) -> bool:
        """True if the frames are not stored upright."""
        return self.transposed or any(self.mirrored)

    def describe(self) -> str:
        """Describe the conversion in words; the text is empty if frames are displayed as stored."""
        done = [
            "turned upright" if self.turned else "",
            "stretched to square pixels" if self.aspect != 1 else "",
            f"tone-mapped from {self.transfer}" if self.transfer else "",
        ]
        return ", ".join(filter(None, done))

    def apply(self, frame: VideoFrame) -> VideoFrame:
        """Convert a stored frame to a displayed one; return the same object if no conversion is needed."""
        if not (self.turned or self.transfer or self.aspect != 1):
            return frame
        if self.aspect != 1:
            width = round(frame.width * self.aspect / 2) * 2
            frame = frame.reformat(width=width, interpolation="BICUBIC", threads=1)
        if self.transfer:
            signal = np.asarray(frame.to_ndarray(format="rgb48le", threads=1), np.uint16)
            image = tone_map(signal, self.transfer)
        else:
            image = np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8)
        return VideoFrame.from_ndarray(np.ascontiguousarray(self._orient(image)), format="rgb24")

    def _orient(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self.transposed:
            image = image.swapaxes(0, 1)
        columns, rows = (-1 if mirror else 1 for mirror in self.mirrored)
        return image[::rows, ::columns]


def read_display(stream: VideoStream, frame: VideoFrame, path: Path) -> FrameDisplay:
    """Read the conversion for display from a stream and its first frame.

    Args:
        stream: Video stream.
        frame: First decoded frame of the stream.
        path: File of the video, for messages.

    Raises:
        MalformedFileError: The display matrix is not a rotation by multiples of 90 degrees, with or without mirroring.
    """
    aspect = Fraction(stream.sample_aspect_ratio or 1)
    data = frame.side_data.get(Type.DISPLAYMATRIX)  # pyright: ignore[reportCallIssue, reportArgumentType]
    # The display matrix maps pixel (p, q) to (a p + c q, b p + d q).
    values = np.eye(3) if data is None else np.frombuffer(bytes(data), np.int32).reshape(3, 3) / _ONE
    (a, b), (c, d) = np.round(values[:2, :2]).astype(int).tolist()
    if not (np.abs(values[:2, :2] - [[a, b], [c, d]]).max() < 0.01 and abs(a * d - b * c) == 1):
        raise MalformedFileError(
            path, "is shown turned by less than a quarter turn", "export the video upright"
        )
    transposed = a == 0
    return FrameDisplay(
        transposed=transposed,
        mirrored=((c if transposed else a) < 0, (b if transposed else d) < 0),
        aspect=aspect if abs(aspect - 1) > _SQUARE else Fraction(1),
        transfer=_TRANSFERS.get(int(frame.color_trc)),
    )
