"""Join videos of one encoding without encoding them again."""

import fractions
import io
from collections.abc import Sequence
from pathlib import Path

import av
import av.error

from aomgen.errors import MalformedFileError, MissingFileError


def concatenate_videos(paths: Sequence[Path], fps: int) -> tuple[bytes, list[int]]:
    """MP4 bytes of several videos one after the other, and the number of frames of each.

    Packets are copied, so images do not change; equal inputs give equal bytes.

    Args:
        paths: Videos written by `io.video.encode_video` at one size and rate.
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
                        stream, settings = target.add_stream_from_template(video), found
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
