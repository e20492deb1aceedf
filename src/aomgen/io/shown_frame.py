"""Decoded video frames as a player shows them: upright, with square pixels, in the range of a screen."""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np
from av import VideoFrame
from av.sidedata.sidedata import Type
from av.video.stream import VideoStream
from numpy.typing import NDArray

from aomgen.core.hdr_transfer import Transfer, tone_map
from aomgen.errors import MalformedFileError

# Transfer characteristics of ITU-T H.273.
_TRANSFERS: Final[dict[int, Transfer]] = {16: "PQ", 18: "HLG"}
# Unit of the entries of a display matrix.
_ONE: Final = 1 << 16
# Pixels whose sides differ by less are square: 1920 of 1919.4 columns.
_SQUARE: Final = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameDisplay:
    """Transformation from the stored frames of a stream to the frames that a player shows.

    Attributes:
        transposed: Rows and columns are exchanged first.
        mirrored: Columns, then rows are reversed.
        aspect: Width of a stored pixel over its height.
        transfer: Curve of a signal of high dynamic range, or None.
    """

    transposed: bool
    mirrored: tuple[bool, bool]
    aspect: Fraction
    transfer: Transfer | None

    @property
    def turned(self) -> bool:
        """True where the frames are not stored upright."""
        return self.transposed or any(self.mirrored)

    def describe(self) -> str:
        """Description of the transformation; empty where frames are shown as stored."""
        done = [
            "turned upright" if self.turned else "",
            "stretched to square pixels" if self.aspect != 1 else "",
            f"tone-mapped from {self.transfer}" if self.transfer else "",
        ]
        return ", ".join(filter(None, done))

    def apply(self, frame: VideoFrame) -> VideoFrame:
        """The frame as it is shown; the same object where nothing has to be done."""
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
    """Read from header and first frame how a player shows a stream.

    Raises:
        MalformedFileError: A display matrix that does not turn by quarter turns.
    """
    aspect = Fraction(stream.sample_aspect_ratio or 1)
    data = frame.side_data.get(Type.DISPLAYMATRIX)  # pyright: ignore[reportCallIssue, reportArgumentType]
    # Pixel (p, q) is shown at (a p + c q, b p + d q).
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
