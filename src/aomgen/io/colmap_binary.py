"""Readers of the binary files of a COLMAP model, with limits on size and typed errors; COLMAP is not needed."""

import struct
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array
from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError, NonFiniteError
from aomgen.io.colmap_models import (
    CAMERA_MODELS,
    MAX_BYTES,
    MAX_COORDINATE,
    REMEDY,
    ColmapCamera,
    ColmapImage,
    check_camera,
    name_camera_model,
    pose_image,
    require_distinct,
)

# Longest image name, [bytes]; four times the limit of common file systems.
MAX_NAME_BYTES: Final = 1024
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<iiQQ")
_IMAGE = struct.Struct("<i7di")
_POINT = struct.Struct("<Q3d3Bd")


def read_cameras_bin(path: Path) -> dict[int, ColmapCamera]:
    """Read the cameras of `cameras.bin`, by camera id.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError, NonFiniteError: The file is missing, too large or invalid.
        UnknownCameraModelError: A camera has an unknown model.
    """
    cursor = _Cursor(path)
    cameras = {}
    for _ in range(cursor.count(_CAMERA.size)):
        key, number, width, height = cursor.take(_CAMERA)
        model = name_camera_model(path, number)
        params = cursor.take(struct.Struct(f"<{CAMERA_MODELS[model]}d"))
        camera = ColmapCamera(model=model, width=width, height=height, params=params)
        cameras[key] = check_camera(path, key, camera)
    cursor.done()
    return cameras


def read_images_bin(path: Path, cameras: dict[int, ColmapCamera]) -> list[ColmapImage]:
    """Read the registered images of `images.bin`, in the order of the file.

    Args:
        path: File `images.bin`.
        cameras: Cameras by camera id; see `read_cameras_bin`.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError, NonFiniteError: The file is missing, too large or invalid.
    """
    cursor = _Cursor(path)
    images = []
    for _ in range(cursor.count(_IMAGE.size)):
        number, *pose, key = cursor.take(_IMAGE)
        name = cursor.text()
        cursor.records(24)  # observations of points: x, y, point id
        images.append(pose_image(path, number, name, cameras.get(key), tuple(pose)))
    cursor.done()
    return require_distinct(path, images)


def read_points_bin(path: Path, views: dict[int, int]) -> tuple[Array, NDArray[np.uint8], NDArray[np.int32]]:
    """Read the points of `points3D.bin`, in the order of the file.

    Args:
        path: File `points3D.bin`.
        views: Index of the view by image id.

    Returns:
        Points (P, 3) in the `recon` frame, sRGB colors (P, 3) uint8, and observations (M, 2) int32, whose rows are
        (index of the point, index of the view).

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError, NonFiniteError: The file is missing, too large or invalid.
    """
    cursor = _Cursor(path)
    count = cursor.count(_POINT.size + _COUNT.size)
    points, colors, tracks = np.empty((count, 3)), np.empty((count, 3), np.uint8), []
    for row in range(count):
        _, x, y, z, red, green, blue, _ = cursor.take(_POINT)
        points[row], colors[row] = (x, y, z), (red, green, blue)
        tracks.append(np.frombuffer(cursor.records(8), "<i4")[::2])  # image id, index
    cursor.done()
    if not np.abs(points).max(initial=0) < MAX_COORDINATE:
        raise NonFiniteError(path, "has a point without finite coordinates", REMEDY)
    numbers = np.concatenate([*tracks, np.zeros(0, np.int32)])
    known, inverse = np.unique(numbers, return_inverse=True)
    strangers = [int(number) for number in known if int(number) not in views]
    if strangers:
        raise MalformedFileError(
            path, f"has points that are seen by the unknown image {strangers[0]}", REMEDY
        )
    seen_by = np.array([views[int(number)] for number in known], np.int32)[inverse]
    seen = np.repeat(np.arange(count, dtype=np.int32), [len(track) for track in tracks])
    return points, colors, np.stack([seen, seen_by], 1)


class _Cursor:
    """Bytes of a file and the current read position; reading past the end raises MalformedFileError."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            remedy = "convert a text model with `colmap model_converter --output_type BIN`"
            raise MissingFileError(path, "is missing", remedy)
        if not path.stat().st_size <= MAX_BYTES:
            raise LimitExceededError(path, f"has {path.stat().st_size} bytes, limit {MAX_BYTES}")
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        if not self.at + layout.size <= len(self.data):
            raise MalformedFileError(self.path, f"ends at byte {len(self.data)} inside a record", REMEDY)
        values = layout.unpack_from(self.data, self.at)
        self.at += layout.size
        return values

    def count(self, smallest: int) -> int:
        """Read a number of records and check that as many records of at least `smallest` bytes can follow."""
        (count,) = self.take(_COUNT)
        if not count * smallest <= len(self.data) - self.at:
            raise MalformedFileError(self.path, f"promises {count} records and ends before them", REMEDY)
        return count

    def records(self, size: int) -> memoryview:
        """Read a number of records and return the bytes of the records that follow, `size` bytes each."""
        start, length = self.at + _COUNT.size, self.count(size) * size
        self.at += length
        return memoryview(self.data)[start : start + length]

    def text(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + MAX_NAME_BYTES)
        if end < 0:
            raise MalformedFileError(self.path, "has an image name without end", REMEDY)
        try:
            name = self.data[self.at : end].decode()
        except UnicodeDecodeError as error:
            raise MalformedFileError(self.path, "has an image name that is not UTF-8", REMEDY) from error
        self.at = end + 1
        return name

    def done(self) -> None:
        if self.at != len(self.data):
            left = len(self.data) - self.at
            raise MalformedFileError(self.path, f"has {left} bytes after its last record", REMEDY)
