"""Video in and out through PyAV, counted by decoding."""

import fractions
import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import av
import av.error
import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array, freeze
from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError

MAX_FRAMES = 20_000
MAX_PIXELS_TOTAL = 8_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Video:
    """Decoded frames with the container's timestamps.

    Attributes:
        times_s: (T,), first frame at its own container time.
        frames_srgb: (T, H, W, 3) uint8.
        fps: Nominal rate of the stream.
    """

    times_s: Array
    frames_srgb: NDArray[np.uint8]
    fps: float

    def __post_init__(self) -> None:
        freeze(self, "times_s", self.times_s, (len(self.frames_srgb),))
        self.frames_srgb.flags.writeable = False


def read_video(path: Path) -> Video:
    """Decode a whole video.

    Raises:
        MissingFileError: No such file.
        MalformedFileError: Not a video, no frames, damaged or truncated stream.
        LimitExceededError: More frames or pixels than are read without asking.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "copy the video or correct capture.toml")
    frames, times = [], []
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            rate = float(stream.average_rate or stream.guessed_rate or 0)
            declared = stream.frames
            for frame in container.decode(stream):
                if frame.pts is None or frame.is_corrupt:
                    raise MalformedFileError(
                        path, f"frame {len(frames)} is damaged", "export the video again"
                    )
                if (
                    not len(frames) < MAX_FRAMES
                    or not frame.width * frame.height * (len(frames) + 1) <= MAX_PIXELS_TOTAL
                ):
                    raise LimitExceededError(
                        path, f"is longer than {MAX_FRAMES} frames or too large", "cut the demonstration"
                    )
                times.append(float(frame.pts * (stream.time_base or 0)))
                frames.append(frame.to_ndarray(format="rgb24", threads=1))
    except (av.error.FFmpegError, IndexError) as error:
        raise MalformedFileError(
            path,
            f"stops being readable after frame {len(frames)} ({error})",
            "copy or export the video again",
        ) from error
    if not frames or (declared and len(frames) < declared):
        raise MalformedFileError(
            path,
            f"has {len(frames)} readable frames of {declared} declared",
            "copy or export the video again",
        )
    if not rate > 0 or not np.all(np.diff(times) > 0):
        raise MalformedFileError(path, "has no increasing frame times", "export it with a constant rate")
    return Video(times_s=np.array(times), frames_srgb=np.stack(frames), fps=rate)


def encode_video(frames: Iterable[NDArray[np.uint8]], fps: int, *, crf: int = 20) -> bytes:
    """MP4 bytes (H.264, yuv420p, a key frame every second frame) of frames (H, W, 3) uint8.

    One thread for colors and one for the encoder, so the same frames always give the same bytes.
    """
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = None
        for index, frame in enumerate(frames):
            if stream is None:
                stream = container.add_stream("libx264", rate=fps)
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.thread_count = 1
                stream.options = {"crf": str(crf), "g": "2", "preset": "veryfast"}
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            picture = picture.reformat(format="yuv420p", threads=1)
            picture.pts = index
            picture.time_base = fractions.Fraction(1, fps)
            container.mux(stream.encode(picture))
        if stream is not None:
            container.mux(stream.encode(None))
    return buffer.getvalue()
