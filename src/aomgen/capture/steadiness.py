"""Did a fixed camera stay fixed? The still background of its video tells."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array
from aomgen.io.images import resize
from aomgen.io.video import Video

# Frames compared with the first one, and the width they are reduced to, [px].
FRAMES, WIDTH = 16, 320
# A shift up to this, in reduced pixels, is rounding; it is 0.3 % of the width.
STILL_PX = 1
# Correlation of the background at the shift over that where it was: 0.2 to 0.5 with a moving arm, 1.3 to 12 after
# a push by 0.6 % of the width.
CLEAR_RATIO = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Push:
    """When a video's background had moved, [s], and by how far, as a share of the width."""

    time_s: float
    share: float


def find_push(video: Video) -> Push | None:
    """The first of some frames from which on the background lies elsewhere than in the first frame.

    Not checked: a push that shifts the background by less than 0.3 % of the width, or a background
    without texture.

    Source: Kuglin & Hines, The phase correlation image alignment method, 1975.
    """
    chosen = np.unique(np.linspace(0, len(video.times_s) - 1, FRAMES).astype(int))
    height, width = video.frames_srgb.shape[1:3]
    size = (min(width, WIDTH), round(height * min(1.0, WIDTH / width)))
    grays = [resize(video.frames_srgb[k], *size).astype(np.float64).mean(2) for k in chosen]
    window = np.outer(np.hanning(size[1]), np.hanning(size[0]))
    first, *others = (np.fft.rfft2(window * (gray - gray.mean())) for gray in grays)
    shifts = np.array([_shift_px(first, other, (size[1], size[0])) for other in others])
    moved = shifts > 0
    # Until the end: what passes before the camera goes again.
    since = len(moved) - int(np.argmin(moved[::-1])) if not moved.all() else 0
    if since == len(moved):
        return None
    return Push(
        time_s=float(video.times_s[chosen[since + 1]]), share=float(np.median(shifts[since:])) / size[0]
    )


def _shift_px(first: NDArray[np.complex128], other: NDArray[np.complex128], size: tuple[int, int]) -> float:
    """How far the background of another frame lies from the first one's, 0 where it stayed, [px]."""
    product = first.conj() * other
    surface: Array = np.fft.irfft2(product / np.maximum(np.abs(product), 1e-9), size)
    rows, columns = np.fft.fftfreq(size[0], 1 / size[0]), np.fft.fftfreq(size[1], 1 / size[1])
    # Nobody pushes a camera by more than a tenth of the image and records on.
    surface = np.where(
        (np.abs(rows)[:, None] <= size[1] / 10) & (np.abs(columns) <= size[1] / 10), surface, -1
    )
    still = (np.abs(rows)[:, None] <= STILL_PX) & (np.abs(columns) <= STILL_PX)
    row, column = np.unravel_index(int(np.argmax(np.where(still, -np.inf, surface))), size)
    if surface[row, column] <= CLEAR_RATIO * surface[still].max():
        return 0.0
    return float(np.hypot(rows[row], columns[column]))
