"""Undistorted images of a recorded video."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.core.lens import Lens, undistorter
from aomgen.io.video import decode_frames


def decode_undistorted(path: Path, lens: Lens | None) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """Yield the time in the video, [s], and the undistorted image (H, W, 3) of each frame, one at a time.

    Args:
        path: File of the video.
        lens: Lens with distortion; None for a pinhole camera, whose images are not changed.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: See `io.video.decode_frames`.
    """
    undistort = undistorter(lens) if lens else None
    for time_s, frame in decode_frames(path):
        image = np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8)
        yield time_s, undistort(image) if undistort else image
