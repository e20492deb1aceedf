"""Thumbnails of the first and last frame of an episode's video, made without decoding the frames between them."""

from pathlib import Path
from typing import Final

import av.error
import numpy as np
from numpy.typing import NDArray

from aomgen.errors import MalformedFileError
from aomgen.io.images import encode_jpeg, resize
from aomgen.io.video import open_stream, read_frames

# Width, [px], and JPEG quality: about 5 kB per image.
WIDTH, QUALITY = 160, 80
REMEDY: Final = "generate the episode again"


def encode_thumbnail(video: Path, frame: str) -> bytes:
    """Encode a small JPEG of the "first" or "last" frame of a video that `encode_video` wrote.

    Raises:
        MissingFileError, MalformedFileError: The video is missing or damaged.
    """
    image = read_frames(video, [0])[0] if frame == "first" else read_last_frame(video)
    height = round(image.shape[0] * WIDTH / image.shape[1])
    return encode_jpeg(resize(image, WIDTH, height), QUALITY)


def read_last_frame(path: Path) -> NDArray[np.uint8]:
    """Read the last frame (H, W, 3) of a video by decoding from the last key frame.

    Raises:
        MissingFileError, MalformedFileError: The video is missing or damaged.
    """
    with open_stream(path) as (container, stream):
        try:
            container.seek(stream.duration or 0, stream=stream)
            *_, last = container.decode(stream)
        except (av.error.FFmpegError, IndexError, ValueError) as error:
            raise MalformedFileError(path, f"cannot be decoded ({error})", REMEDY) from error
        return np.asarray(last.to_ndarray(format="rgb24", threads=1), np.uint8)
