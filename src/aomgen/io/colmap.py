"""Cameras, points and images of a COLMAP project folder, read without COLMAP: bounded, with typed errors.

Binary models of any COLMAP version; only undistorted pinhole cameras. Pixel centres lie at +0.5 in
COLMAP as here, and its cameras look along +z with y down.
"""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.transforms import invert, matrix_from_quat, transform
from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import (
    CalibrationError,
    InputError,
    LimitExceededError,
    MalformedFileError,
    MissingFileError,
    NonFiniteError,
)
from aomgen.io.images import image_size
from aomgen.io.paths import resolve_inside

# Largest file of a model read, [bytes].
MAX_BYTES: Final = 4 << 30
# Longest side of an image, [px]: above that of any camera.
MAX_SIDE: Final = 1 << 16
# Longest image name: four times a file system's limit.
MAX_NAME_BYTES: Final = 1024
# The order of COLMAP's camera models; the first two have no distortion.
_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"),
    *("FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
)
_REMEDY = "export the model again"


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapView:
    """A registered image: its camera, at the size the image has on disk, and where it lies."""

    camera_recon: Camera
    path: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapModel:
    """A sparse reconstruction in COLMAP's own frame (no scale, no gravity).

    Attributes:
        views: Registered images by file name, in name order.
        points_recon: Points (P, 3).
        colors_srgb: Their colors (P, 3) uint8.
        observations: Who sees what, (M, 2) int32: rows of (point, index into `views` in order).
    """

    views: dict[str, ColmapView]
    points_recon: Annotated[Array, "P 3"]
    colors_srgb: Annotated[NDArray[np.uint8], "P 3"]
    observations: Annotated[NDArray[np.int32], "_ 2"]

    __post_init__ = freeze_arrays


def read_colmap(folder: Path, *, images: str = "images") -> ColmapModel:
    """Read `folder/sparse/0` (or `folder/sparse`) and find its images in `folder/images`.

    Images may be smaller or larger copies of the ones that were reconstructed (`images_4`); the
    cameras are scaled to what is on disk.

    Args:
        folder: COLMAP project, as `colmap image_undistorter` writes it.
        images: Name of the folder of images, inside `folder`.

    Raises:
        MissingFileError: No binary model, or an image is missing.
        MalformedFileError: A file of the model is damaged or contradicts another.
        NonFiniteError: A number of the model is NaN or infinite.
        LimitExceededError: A file is larger than 4 GiB.
        CalibrationError: A camera with lens distortion, or an image of another shape.
        UnsafePathError: An image's name leaves the folder of images.

    Not checked: that the images are the ones which were reconstructed.
    """
    model = folder / "sparse" / "0"
    if not model.is_dir():
        model = folder / "sparse"
    optics = _read_cameras(model / "cameras.bin")
    cameras, names = _read_images(model / "images.bin", optics)
    views = {}
    for name in sorted(cameras):
        path = resolve_inside(folder / images, name, named_by=model / "images.bin")
        views[name] = ColmapView(camera_recon=_fit(cameras[name], path), path=path)
    order = {name: index for index, name in enumerate(views)}
    points, colors, observations = _read_points(
        model / "points3D.bin", {key: order[name] for key, name in names.items()}
    )
    return ColmapModel(views=views, points_recon=points, colors_srgb=colors, observations=observations)


def _fit(camera: Camera, path: Path) -> Camera:
    """The camera at the size of the image file."""
    width, height = image_size(path)
    if not abs(width * camera.height - height * camera.width) <= 1.01 * max(camera.width, camera.height):
        raise CalibrationError(
            path,
            f"is {width} x {height}, its camera {camera.width} x {camera.height}: another shape",
            "use the images that were reconstructed",
        )
    return camera.resize(width, height)


class _Cursor:
    """A file's bytes and how far they are read; what a count promises must still be there."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            remedy = "convert a text model with `colmap model_converter --output_type BIN`"
            raise MissingFileError(path, "is missing", remedy)
        if not path.stat().st_size <= MAX_BYTES:
            raise LimitExceededError(path, f"has {path.stat().st_size} bytes, limit {MAX_BYTES}")
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        if not self.at + layout.size <= len(self.data):
            raise MalformedFileError(self.path, f"ends at byte {len(self.data)} inside a record", _REMEDY)
        values = layout.unpack_from(self.data, self.at)
        self.at += layout.size
        return values

    def count(self, smallest: int) -> int:
        """The next number of records, each of at least `smallest` bytes."""
        (count,) = self.take(_COUNT)
        if not count * smallest <= len(self.data) - self.at:
            raise MalformedFileError(self.path, f"promises {count} records and ends before them", _REMEDY)
        return count

    def records(self, size: int) -> memoryview:
        """The bytes of a counted list of records of `size` bytes."""
        start, length = self.at + _COUNT.size, self.count(size) * size
        self.at += length
        return memoryview(self.data)[start : start + length]

    def text(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + MAX_NAME_BYTES)
        if end < 0:
            raise MalformedFileError(self.path, "has an image name without end", _REMEDY)
        try:
            name = self.data[self.at : end].decode()
        except UnicodeDecodeError as error:
            raise MalformedFileError(self.path, "has an image name that is not UTF-8", _REMEDY) from error
        self.at = end + 1
        return name

    def done(self) -> None:
        if self.at != len(self.data):
            left = len(self.data) - self.at
            raise MalformedFileError(self.path, f"has {left} bytes after its last record", _REMEDY)


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<iiQQ")
_IMAGE = struct.Struct("<i7di")
_POINT = struct.Struct("<Q3d3Bd")


def _read_cameras(path: Path) -> dict[int, Camera]:
    """Optics by camera id; the pose is left at the identity."""
    cursor = _Cursor(path)
    cameras = {}
    for _ in range(cursor.count(_CAMERA.size)):
        key, model, width, height = cursor.take(_CAMERA)
        if model not in (0, 1):
            name = _MODELS[model] if 0 <= model < len(_MODELS) else str(model)
            raise CalibrationError(
                path, f"camera {key} has the model {name}, want PINHOLE", "run `colmap image_undistorter`"
            )
        focal_lengths = cursor.take(struct.Struct("<d" if model == 0 else "<2d"))
        cx, cy = cursor.take(struct.Struct("<2d"))
        fx, fy = focal_lengths[0], focal_lengths[-1]
        if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
            raise MalformedFileError(path, f"camera {key} has {width} x {height} pixels", _REMEDY)
        if not (min(fx, fy) > 0 and max(fx, fy, abs(cx), abs(cy)) < 1e9):
            raise NonFiniteError(path, f"camera {key} has the intrinsics {fx}, {fy}, {cx}, {cy}", _REMEDY)
        cameras[key] = Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, T_world_cam=np.eye(4))
    cursor.done()
    return cameras


def _read_images(path: Path, optics: dict[int, Camera]) -> tuple[dict[str, Camera], dict[int, str]]:
    """Posed cameras by image name, and names by the number under which points know the image."""
    cursor = _Cursor(path)
    cameras, names = {}, {}
    for _ in range(cursor.count(_IMAGE.size)):
        number, *pose, key = cursor.take(_IMAGE)
        name = cursor.text()
        cursor.records(24)  # where its points are seen: x, y, point
        quat, t = np.array(pose[:4]), np.array(pose[4:])
        norm = np.linalg.norm(quat)
        if not (np.abs(pose).max() < 1e12 and norm > 1e-6):
            raise NonFiniteError(path, f"image {name!r} has the pose {pose}", _REMEDY)
        if key not in optics or name in cameras or number in names or not name:
            raise MalformedFileError(path, f"image {name!r} has an unknown camera, or stands twice", _REMEDY)
        names[number] = name
        T_cam_recon = transform(matrix_from_quat(quat / norm), t)
        cameras[name] = optics[key].move(invert(T_cam_recon))
    cursor.done()
    if not cameras:
        raise InputError(path, "has no registered image", "reconstruct with more overlap and texture")
    return cameras, names


def _read_points(path: Path, views: dict[int, int]) -> tuple[Array, NDArray[np.uint8], NDArray[np.int32]]:
    """Points (P, 3), sRGB colors (P, 3) and observations (M, 2) in the file's order; `views` by image number."""
    cursor = _Cursor(path)
    count = cursor.count(_POINT.size + _COUNT.size)
    points, colors, tracks = np.empty((count, 3)), np.empty((count, 3), np.uint8), []
    for row in range(count):
        _, x, y, z, red, green, blue, _ = cursor.take(_POINT)
        points[row], colors[row] = (x, y, z), (red, green, blue)
        tracks.append(np.frombuffer(cursor.records(8), "<i4")[::2])  # image, place in it
    cursor.done()
    if not np.abs(points).max(initial=0) < 1e12:
        raise NonFiniteError(path, "has a point without finite coordinates", _REMEDY)
    numbers = np.concatenate([*tracks, np.zeros(0, np.int32)])
    known, inverse = np.unique(numbers, return_inverse=True)
    strangers = [int(number) for number in known if int(number) not in views]
    if strangers:
        raise MalformedFileError(
            path, f"has points that are seen by the unknown image {strangers[0]}", _REMEDY
        )
    seen_by = np.array([views[int(number)] for number in known], np.int32)[inverse]
    seen = np.repeat(np.arange(count, dtype=np.int32), [len(track) for track in tracks])
    return points, colors, np.stack([seen, seen_by], 1)
