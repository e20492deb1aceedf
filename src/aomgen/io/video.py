"""Reading and writing of videos with PyAV; frames are counted by decoding them."""

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
from av.stream import Disposition
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
from aomgen.io.shown_frame import FrameDisplay, read_display

# Largest number of frames that is read, eleven minutes at 30 fps; a demonstration takes less than one minute.
MAX_FRAMES = 20_000
# Largest number of pixels of a video whose decoded frames are held in memory; they take 24 GB at three bytes per pixel.
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
        times_s: Times of the frames (T,), [s], as the container states them; the first may differ from 0.
        frames_srgb: Frames (T, H, W, 3) uint8.
        fps: Mean frame rate, [1/s].
    """

    times_s: Annotated[Array, "T"]
    frames_srgb: Annotated[NDArray[np.uint8], "T H W 3"]
    fps: float

    def __post_init__(self) -> None:
        # `freeze_arrays` would copy a writable array, which may take gigabytes.
        self.frames_srgb.flags.writeable = False
        freeze_arrays(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoInfo:
    """Size, length and rate of a video, read without decoding all of it.

    Attributes:
        width, height: Size of a displayed frame, [px].
        frames: Number of displayed frames.
        fps: Mean frame rate, [1/s].
        display: Conversion of stored frames for display.
    """

    width: int
    height: int
    frames: int
    fps: float
    display: FrameDisplay


def probe_video(path: Path) -> VideoInfo:
    """Count the frames of a video and decode the first one.

    Frames that an edit list excludes, for example after trimming on a phone, are not counted.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: The file is missing, malformed or too large.
    """
    with open_stream(path) as (container, stream):
        try:
            stamps = [
                packet.pts for packet in container.demux(stream) if packet.size and not packet.is_discard
            ]
        except av.error.FFmpegError as error:
            raise MalformedFileError(path, f"cannot be read ({error})", "export the video again") from error
        times_s = [float(stamp * (stream.time_base or 0)) for stamp in stamps if stamp is not None]
    if not len(stamps) <= MAX_FRAMES:
        raise LimitExceededError(path, f"is longer than {MAX_FRAMES} frames", "cut the video")
    first, display = next(_decode(path))[1:]
    return VideoInfo(
        width=first.width, height=first.height, frames=len(stamps), fps=_rate(times_s, path), display=display
    )


def _rate(times_s: Sequence[float], path: Path) -> float:
    """Compute the mean frame rate, [1/s]; `path` names the video in messages."""
    if not (len(times_s) > 1 and max(times_s) > min(times_s)):
        raise MalformedFileError(path, "does not state the times of its frames", "export the video again")
    return (len(times_s) - 1) / (max(times_s) - min(times_s))


def decode_frames(path: Path) -> Iterator[tuple[float, av.VideoFrame]]:
    """Yield the time, [s], and the displayed frame of each frame of a video, one at a time.

    Displayed frames are upright according to the file's display matrix, have square pixels and the dynamic range of
    sRGB (HLG and PQ are tone-mapped).

    Raises:
        MissingFileError: The file does not exist.
        MalformedFileError: The file is not a video, has no frames, has a damaged or truncated stream, or has times that do
            not increase.
        LimitExceededError: The video has more than `MAX_FRAMES` frames.
    """
    return ((time_s, frame) for time_s, frame, _ in _decode(path))


def _decode(path: Path) -> Iterator[tuple[float, av.VideoFrame, FrameDisplay]]:
    count, last, display = 0, -np.inf, None
    with open_stream(path) as (container, stream):
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
                display = display or read_display(stream, frame, path)
                yield time_s, display.apply(frame), display
                count, last = count + 1, time_s
        except (av.error.FFmpegError, IndexError) as error:
            raise MalformedFileError(
                path,
                f"is not readable after frame {count} ({error})",
                "copy or export the video again",
            ) from error
    stored = _count_stored(path) if count < declared else declared
    if not count or stored < declared:
        raise MalformedFileError(
            path,
            f"has {min(count, stored)} readable frames of {declared} declared",
            "copy or export the video again",
        )


def _count_stored(path: Path) -> int:
    """Count the frames in a file, including those that its edit list excludes."""
    with open_stream(path, ignore_editlist="1") as (container, stream):
        return sum(1 for packet in container.demux(stream) if packet.size and not packet.is_corrupt)


def read_video(path: Path) -> Video:
    """Decode a whole video.

    Raises:
        MissingFileError, MalformedFileError: See `decode_frames`.
        LimitExceededError: The video has more than `MAX_FRAMES` frames or `MAX_PIXELS_TOTAL` pixels.
    """
    frames, times = [], []
    for time_s, frame in decode_frames(path):
        if not frame.width * frame.height * (len(frames) + 1) <= MAX_PIXELS_TOTAL:
            raise LimitExceededError(path, "holds more pixels than fit in memory", "cut the demonstration")
        times.append(time_s)
        frames.append(frame.to_ndarray(format="rgb24", threads=1))
    return Video(times_s=np.array(times), frames_srgb=np.stack(frames), fps=_rate(times, path))


def read_frames(path: Path, numbers: Sequence[int]) -> list[NDArray[np.uint8]]:
    """Decode some frames (H, W, 3) of a video, given by their numbers from 0, in the requested order.

    Raises:
        MissingFileError, MalformedFileError: See `decode_frames`; or the video has fewer frames.
    """
    found: dict[int, NDArray[np.uint8]] = {}
    for number, (_, frame) in enumerate(islice(decode_frames(path), max(numbers) + 1)):
        if number in numbers:
            found[number] = np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8)
    if len(found) < len(set(numbers)):
        raise MalformedFileError(path, f"has no frame {max(numbers)}", "make the video again")
    return [found[number] for number in numbers]


@contextmanager
def open_stream(path: Path, **options: str) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open a container, with FFmpeg `options`, and its video stream; streams of cover images are skipped.

    Raises:
        MissingFileError, MalformedFileError: The file does not exist, or it holds no video.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "copy the video or correct capture.toml")
    try:
        # Metadata tags are not used, and some cameras write them in an encoding other than UTF-8.
        container = av.open(str(path), options=options, metadata_errors="replace")
    except av.error.FFmpegError as error:
        raise MalformedFileError(
            path, f"is not a video ({error})", "copy or export the video again"
        ) from error
    with container:
        streams = [
            item for item in container.streams.video if not item.disposition & Disposition.attached_pic
        ]
        if not streams:
            raise MalformedFileError(path, "holds no video", "copy or export the video again")
        chosen = max(streams, key=lambda item: bool(item.disposition & Disposition.default))
        if getattr(chosen, "codec_context", None) is None:
            raise MalformedFileError(path, "has a codec that FFmpeg does not know", "export it as H.264")
        yield container, chosen


def encode_video(
    frames: Iterable[NDArray[np.uint8]], fps: int, *, codec: Codec = "h264", crf: int | None = None
) -> bytes:
    """Encode frames (H, W, 3) uint8 to the content of an MP4 file (yuv420p, a key frame every second frame).

    Equal frames give equal bytes: color conversion and encoder use one thread each, and x264's macroblock tree is off,
    because its AVX-512 code reads uninitialized memory, which made small images vary. This makes files 8 % larger.

    Args:
        frames: Frames of one size.
        fps: Frame rate, [1/s].
        codec: H.264 is supported by most programs; AV1 gives smaller files.
        crf: Constant rate factor; lower values give higher quality. None selects the default of the codec.

    Raises:
        BackendError: The installed PyAV does not have this encoder.
    """
    encoder, options = _ENCODERS[codec]
    if encoder not in av.codecs_available:
        raise BackendError("PyAV", f"has no encoder {encoder}", "install PyAV's own wheel, or choose h264")
    # By default, SVT-AV1 prints its settings; at level 1 it prints errors only.
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
    """Reduce the chroma of an image (H, W, 3) to half resolution (yuv420p), as a video without other losses would."""
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
    halved = frame.reformat(format="yuv420p", threads=1)
    return np.asarray(halved.to_ndarray(format="rgb24", threads=1), np.uint8)


def decode_samples(data: bytes, where: Path, step: int) -> tuple[int, list[NDArray[np.uint8]]]:
    """Count the frames of a video by decoding it, and return every `step`-th of them (H, W, 3).

    `data` is the content of a video file; `where` names it in messages.

    Raises:
        CorruptArtifactError: The video cannot be decoded.
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
    """Concatenate videos to the content of one MP4 file, and count the frames of each.

    Packets are copied without decoding, so images do not change; equal inputs give equal bytes.

    Args:
        paths: Videos written by `encode_video` at one size and rate.
        fps: Frame rate of the videos, [1/s].

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
                    # Duration of a frame in units of the source's time base.
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
