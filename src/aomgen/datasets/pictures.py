"""Pictures of committed episodes at the size of a dataset."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.errors import ConfigError, CorruptArtifactError
from aomgen.io.atomic import write_bytes
from aomgen.io.episode_folder import SAMPLED_FRAMES, CommittedEpisode, color_counts
from aomgen.io.images import resize
from aomgen.io.video import decode_frames, encode_video

# Quality of videos that are encoded again: finer than when rendered, since small pictures have more detail a pixel.
RESIZED_CRF = {"h264": 14, "av1": 15}


def read_pictures(item: CommittedEpisode, camera: str) -> Iterator[NDArray[np.uint8]]:
    """Frames (H, W, 3) of one camera at its size; area-averaged where that is smaller than the video's.

    Raises:
        CorruptArtifactError: The video has another length than the episode.
        MissingFileError, MalformedFileError: See `io.video.decode_frames`.
    """
    view, count = item.episode.cameras[camera], 0
    for _, frame in decode_frames(item.videos[camera]):
        picture = np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8)
        same = picture.shape[:2] == (view.height, view.width)
        yield picture if same else resize(picture, view.width, view.height)
        count += 1
    check_length(item, camera, count)


def check_length(item: CommittedEpisode, camera: str, frames: int) -> None:
    """Refuse a video that does not show every frame of its episode.

    Raises:
        CorruptArtifactError: It has another length.
    """
    if frames != len(item.episode):
        raise CorruptArtifactError(
            item.videos[camera], f"has {frames} frames, the episode {len(item.episode)}", "generate it again"
        )


def count_colors(pictures: list[NDArray[np.uint8]]) -> NDArray[np.int64]:
    """How often each value 0..255 occurs in each channel (3, 256) of some of an episode's pictures."""
    return color_counts(np.stack(pictures[:: max(len(pictures) // SAMPLED_FRAMES, 1)]))


def resize_videos(item: CommittedEpisode, folder: Path) -> CommittedEpisode:
    """The episode with videos at its cameras' size and their color counts; new files lie in `folder`.

    Raises:
        ConfigError: A side of the pictures is odd; videos store colors for two by two pixels.
    """
    videos, counts = dict(item.videos), dict(item.color_counts)
    for name, camera in item.episode.cameras.items():
        if camera.width % 2 or camera.height % 2:
            raise ConfigError("--size", f"{camera.width}x{camera.height} is odd", "videos need even sides")
        pictures = list(read_pictures(item, name))
        videos[name] = folder / f"{item.folder.name}.{name}.mp4"
        counts[name] = count_colors(pictures)
        data = encode_video(pictures, item.episode.fps, codec=item.codec, crf=RESIZED_CRF[item.codec])
        write_bytes(videos[name], data)
    return replace(item, videos=videos, color_counts=counts)
