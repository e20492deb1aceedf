"""Video in and out through PyAV, counted by decoding."""

import fractions
import io
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Annotated, Final, Literal, cast

import av
import av.error
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray

from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import (
    BackendError,
    CorruptArtifactError,
    LimitExceededError,
    MalformedFileError,
    MissingFileError,
)

# Eleven minutes at 30 fps; a demonstration takes less than one.
MAX_FRAMES = 20_000
# Decoded frames stay in memory: 24 GB at three bytes a pixel.
MAX_PIXELS_TOTAL = 8_000_000_000

Codec = Literal["h264", "av1"]
# Encoder of each codec and its options.
_ENCODERS: Final = {
    "h264": ("libx264", {"crf": "20", "g": "2", "preset": "veryfast", "mbtree": "0"}),
    "av1": ("libsvtav1", {"crf": "30", "g": "2", "preset": "9", "svtav1-params": "lp=1"}),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Video:
    """Decoded frames with the container's timestamps.

    Attributes:
        times_s: (T,), first frame at its own container time.
        frames_srgb: (T, H, W, 3) uint8.
        fps: Nominal rate of the stream.
    """

    times_s: Annotated[Array, "T"]
    frames_srgb: Annotated[NDArray[np.uint8], "T H W 3"]
    fps: float

    def __post_init__(self) -> None:
        # Gigabytes: held, not copied.
        self.frames_srgb.flags.writeable = False
        freeze_arrays(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoInfo:
    """What a video's header says: size [px], number of frames, nominal rate [1/s]."""

    width: int
    height: int
    frames: int
    fps: float


def probe_video(path: Path) -> VideoInfo:
    """Read a video's header.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: As their names say; a header
            without a number of frames counts as malformed.
    """
    with _opened(path) as (container, stream):
        frames = stream.frames
        rate = float(stream.average_rate or stream.guessed_rate or 0)
        if not frames and container.duration:
            frames = int(container.duration / av.time_base * rate)
        if not frames or not rate > 0:
            raise MalformedFileError(path, "says neither its length nor its rate", "export the video again")
        if not frames <= MAX_FRAMES:
            raise LimitExceededError(path, f"is longer than {MAX_FRAMES} frames", "cut the video")
        return VideoInfo(width=stream.width, height=stream.height, frames=frames, fps=rate)


def decode_frames(path: Path) -> Iterator[tuple[float, av.VideoFrame]]:
    """Time, [s], and frame, one after the other, so that long videos need no memory.

    Raises:
        MissingFileError: No such file.
        MalformedFileError: Not a video, no frames, damaged or truncated stream, times that do not
            increase.
        LimitExceededError: More frames than are read without asking.
    """
    count, last = 0, -np.inf
    with _opened(path) as (container, stream):
        declared = stream.frames
        try:
            for frame in container.decode(stream):
                if frame.pts is None or frame.is_corrupt:
                    raise MalformedFileError(path, f"frame {count} is damaged", "export the video again")
                if not count < MAX_FRAMES:
                    raise LimitExceededError(path, f"is longer than {MAX_FRAMES} frames", "cut the video")
                time_s = float(frame.pts * (stream.time_base or 0))
                if not time_s > last:
                    raise MalformedFileError(
                        path, "has no increasing frame times", "export it with a constant rate"
                    )
                yield time_s, frame
                count, last = count + 1, time_s
        except (av.error.FFmpegError, IndexError) as error:
            raise MalformedFileError(
                path,
                f"stops being readable after frame {count} ({error})",
                "copy or export the video again",
            ) from error
    if not count or (declared and count < declared):
        raise MalformedFileError(
            path,
            f"has {count} readable frames of {declared} declared",
            "copy or export the video again",
        )


def read_video(path: Path) -> Video:
    """Decode a whole video.

    Raises:
        MissingFileError, MalformedFileError: See `decode_frames`.
        LimitExceededError: More frames or pixels than are read without asking.
    """
    frames, times = [], []
    for time_s, frame in decode_frames(path):
        if not frame.width * frame.height * (len(frames) + 1) <= MAX_PIXELS_TOTAL:
            raise LimitExceededError(path, "holds more pixels than fit in memory", "cut the demonstration")
        times.append(time_s)
        frames.append(frame.to_ndarray(format="rgb24", threads=1))
    with _opened(path) as (_, stream):
        rate = float(stream.average_rate or stream.guessed_rate or 0)
    if not rate > 0:
        raise MalformedFileError(path, "has no frame rate", "export it with a constant rate")
    return Video(times_s=np.array(times), frames_srgb=np.stack(frames), fps=rate)


def read_frames(path: Path, numbers: Sequence[int]) -> list[NDArray[np.uint8]]:
    """Some frames (H, W, 3) of a video, in the order asked for; decodes no farther than the last.

    Raises:
        MissingFileError, MalformedFileError: See `decode_frames`; or there are fewer frames.
    """
    found: dict[int, NDArray[np.uint8]] = {}
    for number, (_, frame) in enumerate(islice(decode_frames(path), max(numbers) + 1)):
        if number in numbers:
            found[number] = np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8)
    if len(found) < len(set(numbers)):
        raise MalformedFileError(path, f"has no frame {max(numbers)}", "make the video again")
    return [found[number] for number in numbers]


@contextmanager
def _opened(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    if not path.is_file():
        raise MissingFileError(path, "is missing", "copy the video or correct capture.toml")
    try:
        container = av.open(str(path))
    except av.error.FFmpegError as error:
        raise MalformedFileError(
            path, f"is not a video ({error})", "copy or export the video again"
        ) from error
    with container:
        if not container.streams.video:
            raise MalformedFileError(path, "holds no pictures", "copy or export the video again")
        yield container, container.streams.video[0]


def encode_video(
    frames: Iterable[NDArray[np.uint8]], fps: int, *, codec: Codec = "h264", crf: int | None = None
) -> bytes:
    """MP4 bytes (yuv420p, a key frame every second frame) of frames (H, W, 3) uint8.

    One thread for colors and one for the encoder, so the same frames always give the same bytes.
    For the same reason x264's macroblock tree is off: its AVX-512 code reads memory that was never
    written, so that small images came out in one of several ways. This makes files 8 % larger.

    Args:
        codec: H.264 is read everywhere, AV1 is smaller.
        crf: Quality, lower is better; None takes the codec's usual one.

    Raises:
        BackendError: This PyAV has no such encoder.
    """
    encoder, options = _ENCODERS[codec]
    if encoder not in av.codecs_available:
        raise BackendError("PyAV", f"has no encoder {encoder}", "install PyAV's own wheel, or choose h264")
    # SVT-AV1 tells its settings otherwise; 1 leaves errors.
    os.environ.setdefault("SVT_LOG", "1")
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = None
        for index, frame in enumerate(frames):
            if stream is None:
                stream = cast(VideoStream, container.add_stream(encoder, rate=fps))
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.thread_count = 1
                stream.options = options if crf is None else options | {"crf": str(crf)}
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            picture = picture.reformat(format="yuv420p", threads=1)
            picture.pts = index
            picture.time_base = fractions.Fraction(1, fps)
            container.mux(stream.encode(picture))
        if stream is not None:
            container.mux(stream.encode(None))
    return buffer.getvalue()


def halve_colors(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image (H, W, 3) as the best video would show it: with one color for two by two pixels (yuv420p)."""
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
    halved = frame.reformat(format="yuv420p", threads=1)
    return np.asarray(halved.to_ndarray(format="rgb24", threads=1), np.uint8)


def decode_samples(data: bytes, where: Path, step: int) -> tuple[int, list[NDArray[np.uint8]]]:
    """How many frames a video's bytes really hold, and every `step`-th of them (H, W, 3).

    Raises:
        CorruptArtifactError: The bytes cannot be decoded; `where` names them.
    """
    count, samples = 0, []
    try:
        with av.open(io.BytesIO(data)) as container:
            container.streams.video[0].thread_count = 1
            for frame in container.decode(video=0):
                if frame.is_corrupt:
                    raise CorruptArtifactError(
                        where, f"frame {count} is damaged", "generate the episode again"
                    )
                if count % step == 0:
                    samples.append(np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8))
                count += 1
    except (av.error.FFmpegError, IndexError) as error:
        raise CorruptArtifactError(
            where, f"cannot be decoded ({error})", "generate the episode again"
        ) from error
    return count, samples


def concatenate_videos(paths: Sequence[Path], fps: int) -> tuple[bytes, list[int]]:
    """MP4 bytes of several videos one after the other, and the number of frames of each.

    Packets are copied, so images do not change; equal inputs give equal bytes.

    Args:
        paths: Videos written by `encode_video` at one size and rate.
        fps: Their rate.

    Raises:
        MissingFileError, MalformedFileError: A video is missing, damaged or of another encoding.
    """
    buffer, counts, shift = io.BytesIO(), [], 0
    with av.open(buffer, "w", format="mp4") as target:
        stream, settings = None, None
        for path in paths:
            if not path.is_file():
                raise MissingFileError(path, "is missing", "generate the episode again")
            try:
                with av.open(str(path)) as source:
                    video = source.streams.video[0]
                    codec = video.codec_context
                    found = (codec.name, codec.width, codec.height, bytes(codec.extradata or b""))
                    if stream is None:
                        stream, settings = target.add_stream_from_template(video, opaque=True), found
                    if found != settings:
                        raise MalformedFileError(
                            path, "has another size or encoding", "generate the episodes again"
                        )
                    count = 0
                    # A frame's length in the ticks of the source's clock.
                    ticks = 1 / (fractions.Fraction(video.time_base or 1) * fps)
                    for packet in source.demux(video):
                        if packet.pts is None or packet.dts is None:
                            continue
                        packet.pts += int(shift * ticks)
                        packet.dts += int(shift * ticks)
                        packet.stream = stream
                        target.mux(packet)
                        count += 1
            except (av.error.FFmpegError, IndexError) as error:
                raise MalformedFileError(
                    path, f"cannot be read ({error})", "generate the episode again"
                ) from error
            counts.append(count)
            shift += count
    return buffer.getvalue(), counts
