"""Cameras and posed images of a COLMAP model, with the checks that binary and text files share."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from aomgen.core.transforms import invert, matrix_from_quat, transform
from aomgen.core.values import Matrix4, freeze_arrays
from aomgen.errors import MalformedFileError, NonFiniteError, UnknownCameraModelError

# Largest file of a model that is read, [bytes].
MAX_BYTES: Final = 4 << 30
# Longest side of an image, [px]; no camera has larger images.
MAX_SIDE: Final = 1 << 16
# Number of parameters of each COLMAP camera model, in the order of the model ids.
CAMERA_MODELS: Final = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
}
# Upper limit of the parameters of a camera, far above those of real cameras.
MAX_PARAMETER: Final = 1e9
# Upper limit of coordinates, far above those of real scenes.
MAX_COORDINATE: Final = 1e12
REMEDY: Final = "export the model again"


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapCamera:
    """Intrinsic parameters of a camera, including lens distortion.

    Attributes:
        model: A key of `CAMERA_MODELS`.
        width, height: Image size, [px].
        params: Parameters in COLMAP's order: focal lengths and principal point, [px], then distortion.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapImage:
    """A registered image.

    Attributes:
        number: Image id, by which points refer to the image.
        name: Path relative to the folder of images.
        camera: Camera that took the image.
        T_recon_cam: Pose of the camera (4, 4), OpenCV axes.
    """

    number: int
    name: str
    camera: ColmapCamera
    T_recon_cam: Matrix4

    __post_init__ = freeze_arrays


def name_camera_model(path: Path, number: int) -> str:
    """Return the name of the camera model with the id `number`; `path` is the file that contains the id.

    Raises:
        UnknownCameraModelError: No model has this id.
    """
    if not 0 <= number < len(CAMERA_MODELS):
        raise UnknownCameraModelError(path, str(number), CAMERA_MODELS)
    return list(CAMERA_MODELS)[number]


def check_camera(path: Path, key: int, camera: ColmapCamera) -> ColmapCamera:
    """Check the values of a camera and return it.

    Args:
        path: File of the camera, for messages.
        key: Camera id, for messages.
        camera: Camera to check.

    Raises:
        UnknownCameraModelError: The model is unknown.
        MalformedFileError: A side is outside 1..65536 px, or the number of parameters does not fit the model.
        NonFiniteError: A parameter is NaN or at least `MAX_PARAMETER` in magnitude, or the first focal length is not positive.
    """
    if camera.model not in CAMERA_MODELS:
        raise UnknownCameraModelError(path, camera.model, CAMERA_MODELS)
    want = CAMERA_MODELS[camera.model]
    if len(camera.params) != want:
        raise MalformedFileError(
            path, f"camera {key} has {len(camera.params)} parameters, {camera.model} has {want}", REMEDY
        )
    if not (0 < camera.width <= MAX_SIDE and 0 < camera.height <= MAX_SIDE):
        raise MalformedFileError(path, f"camera {key} has {camera.width} x {camera.height} pixels", REMEDY)
    params = np.array(camera.params)
    if not (params[0] > 0 and np.abs(params).max() < MAX_PARAMETER):
        listed = ", ".join(f"{value:g}" for value in camera.params)
        raise NonFiniteError(path, f"camera {key} has the intrinsics {listed}", REMEDY)
    return camera


def pose_image(
    path: Path, number: int, name: str, camera: ColmapCamera | None, pose: tuple[float, ...]
) -> ColmapImage:
    """Build an image from its stored pose.

    Args:
        path: File of the image, for messages.
        number: Image id.
        name: Path relative to the folder of images.
        camera: Camera of the image; None if the file refers to an unknown one, which is an error.
        pose: Quaternion wxyz and translation of T_cam_recon, 7 numbers.

    Raises:
        NonFiniteError: The pose is not finite, or its quaternion has length zero.
        MalformedFileError: The name is empty, or `camera` is None.
    """
    quat, t = np.array(pose[:4]), np.array(pose[4:])
    norm = np.linalg.norm(quat)
    if not (np.abs(pose).max() < MAX_COORDINATE and norm > 1e-6):
        raise NonFiniteError(path, f"image {name!r} has the pose {list(pose)}", REMEDY)
    if camera is None or not name:
        raise MalformedFileError(path, f"image {name!r} has an unknown camera, or no name", REMEDY)
    T_cam_recon = transform(matrix_from_quat(quat / norm), t)
    return ColmapImage(number=number, name=name, camera=camera, T_recon_cam=invert(T_cam_recon))


def require_distinct(path: Path, images: list[ColmapImage]) -> list[ColmapImage]:
    """Check that names and ids are unique and that there is at least one image, and return the images.

    Raises:
        MalformedFileError: A name or id is listed twice, or there is no image.
    """
    if not images:
        raise MalformedFileError(path, "has no registered image", "reconstruct with more overlap and texture")
    for kind in ("name", "number"):
        seen = set()
        for image in images:
            if getattr(image, kind) in seen:
                raise MalformedFileError(path, f"image {image.name!r} is listed twice", REMEDY)
            seen.add(getattr(image, kind))
    return images
