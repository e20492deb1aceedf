"""Camera names derived from topics and features, and selection of the videos of an episode."""

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

from aomgen.errors import ConfigError, IncompleteCaptureError, UnknownNameError
from aomgen.importers.recorded import RecordedVideo
from aomgen.importers.video_writing import copy_file

# Components of topics and features that name the message type and not the camera.
_GENERIC: Final = re.compile(
    r"^(observation|observations|images?|image_raw|image_color|image_rect|image_rect_color|raw|rgb|color|compressed|"
    r"video|h264|camera)$"
)
# Cameras with these names move with the arm; a capture needs fixed cameras.
_MOVING: Final = re.compile(r"wrist|hand|gripper|eef|end_effector", re.IGNORECASE)


def make_camera_name(source: str) -> str:
    """Derive the name of a camera from a topic or a feature.

    Example:
        >>> make_camera_name("/front/color/image_raw/compressed"), make_camera_name("observation.images.top")
        ('front', 'top')
    """
    parts = [part for part in re.split(r"[/.]", source) if part and not _GENERIC.match(part.lower())]
    return re.sub(r"[^A-Za-z0-9_-]+", "_", "_".join(parts)) or "camera"


def choose_videos(
    videos: Sequence[RecordedVideo], stated: Sequence[str], where: object
) -> list[RecordedVideo]:
    """Choose the videos that become cameras of the capture.

    Args:
        stated: Entries `NAME` or `NAME=SOURCE`; a source is a topic, a feature or a video file. If empty, all videos of
            cameras that do not move with the arm are chosen.
        where: The recording, for messages.

    Raises:
        IncompleteCaptureError: There is no video.
        ConfigError: An entry names a camera twice, or all cameras move with the arm.
        UnknownNameError: An entry names an unknown video; the error lists the known ones.
    """
    if stated:
        chosen = [_find_stated(videos, entry) for entry in stated]
        names = [video.name for video in chosen]
        if len(set(names)) != len(names):
            raise ConfigError(
                "--camera", f"gives two cameras the same name ({', '.join(names)})", "give NAME=SOURCE"
            )
        return chosen
    if not videos:
        raise IncompleteCaptureError(where, "holds no video", "give a video file: --camera front=FILE")
    fixed = [video for video in videos if not _MOVING.search(video.source)]
    if not fixed:
        listed = ", ".join(video.source for video in videos)
        raise ConfigError(
            where, f"contains only videos whose names indicate cameras on the arm: {listed}",
            "select a fixed camera with --camera NAME=SOURCE",
        )  # fmt: skip
    names = [video.name for video in fixed]
    if len(set(names)) != len(names):
        listed = ", ".join(video.source for video in fixed)
        raise ConfigError(
            where, f"holds several videos of one camera: {listed}", "choose with --camera NAME=SOURCE"
        )
    return fixed


def _find_stated(videos: Sequence[RecordedVideo], entry: str) -> RecordedVideo:
    name, equals, source = (part.strip() for part in entry.partition("="))
    wanted = source if equals else name
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise ConfigError(
            "--camera", f"'{name}' is not a valid name", "use letters, digits, _ and -, as in front=SOURCE"
        )
    for video in videos:
        if wanted in (video.source, video.name):
            return RecordedVideo(name=name, source=video.source, write=video.write)
    if equals and Path(source).is_file():
        return RecordedVideo(name=name, source=source, write=partial(copy_file, Path(source)))
    raise UnknownNameError("--camera", wanted, [video.source for video in videos])
