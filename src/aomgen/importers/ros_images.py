"""Decoding of ROS image messages."""

from pathlib import Path
from typing import Any, Final

import av
import numpy as np
from numpy.typing import NDArray

from aomgen.errors import LimitExceededError, MalformedFileError
from aomgen.io.images import MAX_PIXELS, decode_image

# Bytes per pixel by encoding, and the indices of red, green and blue.
_ORDERS: Final[dict[str, tuple[int, tuple[int, int, int]]]] = {
    "rgb8": (3, (0, 1, 2)), "bgr8": (3, (2, 1, 0)), "8UC3": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)), "bgra8": (4, (2, 1, 0)), "8UC4": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)), "8UC1": (1, (0, 0, 0)),
}  # fmt: skip
# Encodings with two bytes per pixel, by FFmpeg's names.
_SHARED_COLORS: Final = {"yuv422": "uyvy422", "uyvy": "uyvy422", "yuv422_yuy2": "yuyv422", "yuyv": "yuyv422"}


def read_image_message(message: Any, source: str) -> NDArray[np.uint8]:
    """Decode a `sensor_msgs` Image or CompressedImage to an image (H, W, 3) uint8 sRGB.

    Args:
        source: Recording and topic, for messages.

    Raises:
        MalformedFileError: The encoding is unknown, or there are fewer bytes than the header states.
        LimitExceededError: The image has more pixels than the limit.
    """
    if not hasattr(message, "encoding"):
        return decode_image(bytes(message.data), Path(source))
    height, width, step = int(message.height), int(message.width), int(message.step)
    if not 0 < width * height <= MAX_PIXELS:
        raise LimitExceededError(source, f"has an image of {width} x {height} pixels, limit {MAX_PIXELS}")
    shared = _SHARED_COLORS.get(message.encoding)
    depth, order = (2, None) if shared else _ORDERS.get(message.encoding, (0, None))
    if not depth:
        known = ", ".join((*_ORDERS, *_SHARED_COLORS))
        raise MalformedFileError(
            source,
            f"has images of encoding '{message.encoding}' (known: {known})",
            "record it as rgb8 or compressed",
        )
    data = np.asarray(message.data, np.uint8)
    if not (step >= depth * width and len(data) >= step * height):
        raise MalformedFileError(
            source,
            f"has {len(data)} bytes for {width} x {height} pixels of '{message.encoding}'",
            "record it again",
        )
    rows = data[: step * height].reshape(height, step)[:, : depth * width]
    pixels = np.ascontiguousarray(rows.reshape(height, width, depth))
    if order is not None:
        return np.ascontiguousarray(pixels[..., order])
    frame = av.VideoFrame.from_ndarray(pixels, format=shared or "")
    return np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8)
