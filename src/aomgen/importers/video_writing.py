"""MP4 files whose frames keep the times of the recording; encoded streams are copied if possible."""

import io
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from shutil import copyfile
from typing import Final, cast

import av
import av.error
import numpy as np
from av.container import InputContainer, OutputContainer
from av.packet import Packet
from av.video.stream import VideoStream
from numpy.typing import NDArray

from aomgen.core.values import Array
from aomgen.errors import AomgenError, IncompleteCaptureError, MalformedFileError
from aomgen.importers.recorded import WrittenVideo
from aomgen.io.video import decode_frames, open_stream

# Clock rate of written frames; recordings have time stamps with a resolution of a millisecond or better, [1/s].
TICKS: Final = 1_000_000
# Close to the visually lossless limit of x264: 45 dB or more for images of a lab.
CRF: Final = "8"
# Codecs that MP4 supports and FFmpeg decodes on all platforms.
COPIED: Final = ("h264", "hevc", "av1", "mpeg4", "vp9")
# Tolerance of an episode's start and end, whose time stamps are rounded; too small to include another frame, [frames].
SPAN_SLACK: Final = 0.25
# NAL type of the sequence parameter set, which a decoder needs first.
SPS: Final = 7
# Mask of the type in a NAL header: the lower five bits.
NAL_TYPE: Final = 0x1F


def encode_frames(
    frames: Iterable[tuple[float, NDArray[np.uint8]]], target: Path, source: object
) -> WrittenVideo:
    """Encode frames (H, W, 3) uint8 with their times, [s], as H.264.

    A frame whose time is not later than that of the previous frame is dropped and counted.

    Args:
        source: Name of the recording and its topic, for messages.

    Raises:
        IncompleteCaptureError: There are no frames.
        MalformedFileError: The frames have different sizes.
    """
    times: list[float] = []
    dropped, stream, size = 0, None, None
    with av.open(str(target), "w", format="mp4", options={"video_track_timescale": str(TICKS)}) as container:
        for time_s, image in frames:
            if stream is None:
                stream, size = _add_encoder(container, image), image.shape
            if image.shape != size:
                raise MalformedFileError(
                    source, f"has a frame of {image.shape} after frames of {size}", "record it with one size"
                )
            if times and not round((time_s - times[0]) * TICKS) > round((times[-1] - times[0]) * TICKS):
                dropped += 1
                continue
            times.append(time_s)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame = frame.reformat(format=stream.codec_context.pix_fmt, threads=1)
            frame.time_base = Fraction(1, TICKS)
            frame.pts = round((time_s - times[0]) * TICKS)
            container.mux(stream.encode(frame))
        if stream is None:
            raise IncompleteCaptureError(
                source, "has no frames", "record the video again or choose another one"
            )
        container.mux(stream.encode(None))
    notes = [f"{len(times)} images of {source} are encoded as H.264"]
    if dropped:
        notes.append(f"{dropped} images of {source} without a later time stamp were dropped")
    return WrittenVideo(
        start_s=times[0], times_s=_check_written(target, len(times), source), notes=tuple(notes)
    )


def _add_encoder(container: OutputContainer, image: NDArray[np.uint8]) -> VideoStream:
    # The rate is only a hint for the encoder; each frame has a time stamp.
    stream = cast(VideoStream, container.add_stream("libx264", rate=30))
    stream.height, stream.width = image.shape[:2]
    # Chroma subsampling needs even sides.
    stream.pix_fmt = "yuv420p" if not any(side % 2 for side in image.shape[:2]) else "yuv444p"
    stream.codec_context.time_base = Fraction(1, TICKS)
    stream.time_base = Fraction(1, TICKS)
    stream.thread_count = 1
    stream.options = {"crf": CRF, "g": "30", "bf": "0", "preset": "veryfast"}
    return stream


def copy_file(source: Path, target: Path) -> WrittenVideo:
    """Copy a video file; a container other than MP4 is converted.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: See `io.video.decode_frames`.
    """
    with open_stream(source) as (container, stream):
        is_mp4 = (
            "mp4" in container.format.name.split(",") and stream.codec_context.codec.canonical_name in COPIED
        )
    if not is_mp4:
        return copy_span(source, target, -np.inf, np.inf)
    times = [time_s for time_s, _ in decode_frames(source)]
    copyfile(source, target)
    return WrittenVideo(start_s=None, times_s=np.array(times))


def copy_span(source: Path, target: Path, start_s: float, end_s: float) -> WrittenVideo:
    """Copy the frames of a file from `start_s` until before `end_s`, [s], so that the first one is at 0.

    Packets are copied if the span begins with a key frame; otherwise its frames are encoded again.

    Raises:
        MissingFileError, MalformedFileError: The file is missing or damaged.
        IncompleteCaptureError: The file has no frames in the span.
    """
    with open_stream(source) as (container, stream):
        half_s = SPAN_SLACK / float(stream.average_rate or 30)
        span = start_s - half_s, end_s - half_s
        try:
            packets = _read_span(container, stream, span)
            if packets and stream.codec_context.codec.canonical_name in COPIED and _starts_alone(packets):
                _mux(packets, stream, target)
                times = _check_written(target, len(packets), source)
                return WrittenVideo(start_s=0.0, times_s=times)
        except (av.error.FFmpegError, MalformedFileError, ValueError):
            # Packets that cannot be copied may still be decodable; a damaged file is refused below.
            target.unlink(missing_ok=True)
    frames = (
        (time_s, np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8))
        for time_s, frame in decode_frames(source)
        if span[0] <= time_s < span[1]
    )
    written = encode_frames(frames, target, source)
    return WrittenVideo(start_s=0.0, times_s=written.times_s, notes=written.notes)


def _read_span(container: InputContainer, stream: VideoStream, span: tuple[float, float]) -> list[Packet]:
    """Return the packets of the frames in a span of time, in decoding order."""
    unit = stream.time_base or Fraction(1)
    if np.isfinite(span[0]) and span[0] > 0:
        container.seek(int(span[0] / float(unit)), stream=stream)
    packets: list[Packet] = []
    for packet in container.demux(stream):
        if packet.pts is None or packet.dts is None or not packet.size or packet.is_discard:
            continue
        if float(packet.dts * unit) >= span[1]:
            break
        if span[0] <= float(packet.pts * unit) < span[1]:
            packets.append(packet)
    return packets


def _starts_alone(packets: Sequence[Packet]) -> bool:
    """Return whether the first packet is a key frame and is displayed first."""
    return packets[0].is_keyframe and all((packet.pts or 0) >= (packets[0].pts or 0) for packet in packets)


def _mux(packets: Sequence[Packet], stream: VideoStream, target: Path) -> None:
    """Write packets to an MP4 file in which the first one is displayed at time 0."""
    unit = stream.time_base or Fraction(1)
    options = {"video_track_timescale": str(unit.denominator)} if unit.numerator == 1 else {}
    with av.open(str(target), "w", format="mp4", options=options) as container:
        copied = container.add_stream_from_template(stream, opaque=True)
        copied.time_base = unit
        first = packets[0].pts or 0
        for packet in packets:
            packet.pts, packet.dts = (packet.pts or 0) - first, (packet.dts or 0) - first
            packet.stream = copied
            container.mux(packet)


def write_h264(packets: Iterable[tuple[float, bytes]], target: Path, source: object) -> WrittenVideo:
    """Write H.264 packets in Annex B form with their times, [s]; each contains one frame.

    Packets before the first key frame cannot be decoded; they are dropped and counted.

    Raises:
        IncompleteCaptureError: There is no key frame.
        MalformedFileError: The packets are not H.264, or the times do not increase.
    """
    kept: list[tuple[float, bytes]] = []
    dropped = 0
    for time_s, data in packets:
        if kept or _holds_parameters(data):
            kept.append((time_s, data))
        else:
            dropped += 1
    if not kept:
        raise IncompleteCaptureError(
            source,
            f"has {dropped} packets and no key frame" if dropped else "has no frames",
            "record the video again or choose another one",
        )
    times = np.array([time_s for time_s, _ in kept])
    if not (np.diff(times) > 0).all():
        raise MalformedFileError(source, "has no increasing time stamps", "record the video again")
    notes = (f"{dropped} packets of {source} before the first key frame were dropped",) if dropped else ()
    try:
        with av.open(io.BytesIO(b"".join(data for _, data in kept)), format="h264") as container:
            stream = container.streams.video[0]
            found = [packet for packet in container.demux(stream) if packet.size]
            if len(found) != len(kept):
                raise MalformedFileError(
                    source,
                    f"has {len(found)} frames in {len(kept)} packets",
                    "record one frame in each packet",
                )
            _stamp(found, times)
            _mux(found, stream, target)
    except (av.error.FFmpegError, IndexError) as error:
        raise MalformedFileError(source, f"is not readable as H.264 ({error})", "record it again") from error
    # If the display order differs from the packet order, the times do not increase, which is detected here.
    written = _check_written(target, len(found), source)
    return WrittenVideo(start_s=float(times[0]), times_s=written, notes=notes)


def _holds_parameters(data: bytes) -> bool:
    """Return whether one of the units of a packet, each of which follows a start code, is a sequence parameter set."""
    return any(unit and unit[0] & NAL_TYPE == SPS for unit in data.split(b"\0\0\1")[1:])


def _stamp(packets: Sequence[Packet], times_s: Array) -> None:
    for packet, time_s in zip(packets, times_s - times_s[0], strict=True):
        packet.time_base = Fraction(1, TICKS)
        packet.pts = packet.dts = round(float(time_s) * TICKS)


def _check_written(target: Path, count: int, source: object) -> Array:
    """Return the times of a written file's frames, [s], after decoding each of them.

    Raises:
        MalformedFileError: The frames cannot be decoded, or their number differs.
    """
    try:
        times = [time_s for time_s, _ in decode_frames(target)]
    except AomgenError as error:
        raise MalformedFileError(
            source, f"has a damaged video ({error.problem})", "record it again"
        ) from error
    if len(times) != count:
        raise MalformedFileError(source, f"has {len(times)} readable frames of {count}", "record it again")
    return np.array(times)
