"""Readers of the text files of a COLMAP model, with limits on size and typed errors."""

from collections.abc import Iterator
from pathlib import Path

from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError
from aomgen.io.colmap_models import (
    MAX_BYTES,
    REMEDY,
    ColmapCamera,
    ColmapImage,
    check_camera,
    pose_image,
    require_distinct,
)


def read_cameras_txt(path: Path) -> dict[int, ColmapCamera]:
    """Read the cameras of `cameras.txt`, by camera id.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError, NonFiniteError: The file is missing, too large or invalid.
        UnknownCameraModelError: A camera has an unknown model.
    """
    cameras = {}
    for number, line in _read_lines(path):
        words = line.split()
        if not words:
            continue
        try:
            key, model, (width, height) = int(words[0]), words[1], map(int, words[2:4])
            params = tuple(float(word) for word in words[4:])
        except (ValueError, IndexError) as error:
            raise MalformedFileError(f"{path}, line {number}", "is not a camera", REMEDY) from error
        camera = ColmapCamera(model=model, width=width, height=height, params=params)
        cameras[key] = check_camera(path, key, camera)
    return cameras


def read_images_txt(path: Path, cameras: dict[int, ColmapCamera]) -> list[ColmapImage]:
    """Read the registered images of `images.txt`, in the order of the file.

    An image has two lines: its pose, and its observations of points, which may be empty.

    Args:
        path: File `images.txt`.
        cameras: Cameras by camera id; see `read_cameras_txt`.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError, NonFiniteError: The file is missing, too large or invalid.
    """
    images = []
    lines = _read_lines(path)
    for number, line in lines:
        words = line.split(maxsplit=9)
        if not words:
            continue
        try:
            key, camera = int(words[0]), int(words[8])
            pose = tuple(float(word) for word in words[1:8])
            name = words[9].strip()
        except (ValueError, IndexError) as error:
            raise MalformedFileError(f"{path}, line {number}", "is not an image", REMEDY) from error
        images.append(pose_image(path, key, name, cameras.get(camera), pose))
        next(lines, None)
    return require_distinct(path, images)


def _read_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number, from 1, and the text of each line that is not a comment."""
    if not path.is_file():
        raise MissingFileError(path, "is missing", "give the folder of a COLMAP model")
    if not path.stat().st_size <= MAX_BYTES:
        raise LimitExceededError(path, f"has {path.stat().st_size} bytes, limit {MAX_BYTES}")
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, 1):
                if not line.startswith("#"):
                    yield number, line
    except UnicodeDecodeError as error:
        raise MalformedFileError(path, "is not UTF-8 text", REMEDY) from error
