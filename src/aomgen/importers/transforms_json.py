"""`transforms.json` of nerfstudio and instant-ngp."""

from math import tan
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, ValidationError

from aomgen.errors import CalibrationError, MalformedFileError, MissingFileError, UnknownCameraModelError
from aomgen.importers.scan_source import (
    ScanImage,
    ScanSource,
    describe_missing_poses,
    name_images,
    read_opengl_pose,
)
from aomgen.io.artifact import read_json
from aomgen.io.colmap_models import ColmapCamera, check_camera
from aomgen.io.images import image_size
from aomgen.io.paths import resolve_inside
from aomgen.io.schema import complaint

TRANSFORMS_FILE: Final = "transforms.json"
# Largest share of missing images: users remove blurred images from exports; if more are missing, the file belongs to
# other images.
MAX_MISSING_SHARE: Final = 0.5
# Suffixes that are tried; image names may lack theirs, as in the synthetic scenes of NeRF.
SUFFIXES: Final = ("", ".png", ".jpg", ".jpeg")
# Distortion coefficients of each camera model, in COLMAP's order after fx, fy, cx, cy.
COEFFICIENTS: Final = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1", "k2", "p1", "p2"),
    "RADIAL": ("k1", "k2", "p1", "p2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
# COLMAP's name of the model with these coefficients.
COLMAP_NAMES: Final = {(): "PINHOLE"} | {
    coefficients: name for name, coefficients in COEFFICIENTS.items() if "RADIAL" not in name and coefficients
}


class CameraFields(BaseModel):
    """Camera model of a whole file, or of one frame."""

    model_config = ConfigDict(extra="allow", frozen=True)

    camera_model: str | None = None
    is_fisheye: bool | None = None
    camera_angle_x: float | None = None
    w: float | None = None
    h: float | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    k5: float | None = None
    k6: float | None = None
    p1: float | None = None
    p2: float | None = None


class TransformsFrame(CameraFields):
    file_path: str
    transform_matrix: list[list[float]] | None = None


class TransformsFile(CameraFields):
    frames: list[TransformsFrame]


def read_transforms(path: Path) -> ScanSource:
    """Read the images of a `transforms.json`.

    Raises:
        MalformedFileError: The file does not follow its format.
        MissingFileError, UnsafePathError: Most images are missing, or one lies outside the file's folder.
        UnknownCameraModelError, CalibrationError: The camera model is unknown or invalid.
        NonFiniteError, ScanPoseError: A pose is not rigid.
    """
    data = read_json(path)
    try:
        stored = TransformsFile.model_validate(data)
    except ValidationError as error:
        raise MalformedFileError(path, *complaint(error, TransformsFile)) from error
    if not stored.frames:
        raise MalformedFileError(path, "lists no frames", "export the scan again")
    listed = sorted(stored.frames, key=lambda frame: frame.file_path)
    frames, missing = _leave_out_missing(listed, path)
    names = name_images([frame.file_path for frame in frames], path)
    common = _list_fields(stored)
    images = []
    for name, frame in zip(names, frames, strict=True):
        image = _find_image(path, frame.file_path)
        pose = frame.transform_matrix
        images.append(
            ScanImage(
                name=name.removesuffix(image.suffix) + image.suffix,
                path=image,
                camera=_read_camera(common | _list_fields(frame), path, image),
                T_scan_cam=None if pose is None else read_opengl_pose(pose, path, name),
            )
        )
    return ScanSource(
        kind="transforms.json", images=tuple(images), warnings=missing + describe_missing_poses(images)
    )


def _leave_out_missing(
    frames: list[TransformsFrame], path: Path
) -> tuple[list[TransformsFrame], tuple[str, ...]]:
    """Return the frames with an existing image, and a warning about the others.

    Raises:
        MissingFileError: Most images are missing.
    """
    missing = []
    for frame in frames:
        try:
            _find_image(path, frame.file_path)
        except MissingFileError as error:
            missing.append((frame, error))
    if not missing:
        return frames, ()
    if len(missing) > MAX_MISSING_SHARE * len(frames):
        raise missing[0][1]
    gone = {id(frame) for frame, _ in missing}
    sentence = f"{len(missing)} of {len(frames)} images are missing ({missing[0][0].file_path})"
    return [frame for frame in frames if id(frame) not in gone], (sentence,)


def _list_fields(fields: CameraFields) -> dict[str, Any]:
    """Return the stated fields of the camera model."""
    return fields.model_dump(include=set(CameraFields.model_fields), exclude_none=True)


def _find_image(path: Path, reference: str) -> Path:
    for suffix in SUFFIXES:
        if (path.parent / f"{reference}{suffix}").is_file():
            return resolve_inside(path.parent, f"{reference}{suffix}", named_by=path)
    return resolve_inside(path.parent, reference, named_by=path)


def _read_camera(stated: dict[str, Any], path: Path, image: Path) -> ColmapCamera:
    width, height = _read_size(stated, path, image)
    fl_x = stated.get("fl_x", 0.0)
    if not fl_x and stated.get("camera_angle_x"):
        fl_x = 0.5 * width / tan(0.5 * stated["camera_angle_x"])
    model = stated.get("camera_model", "OPENCV_FISHEYE" if stated.get("is_fisheye") else "OPENCV")
    if model not in COEFFICIENTS:
        raise UnknownCameraModelError(path, model, COEFFICIENTS)
    if model == "OPENCV" and stated.get("k4"):
        raise CalibrationError(
            path, "states k4 of a camera that is not a fisheye camera", "undistort the images"
        )
    if model == "OPENCV" and stated.get("k3"):
        model = "FULL_OPENCV"
    coefficients = COEFFICIENTS[model]
    values = tuple(float(stated.get(name, 0.0)) for name in coefficients)
    camera = ColmapCamera(
        model=COLMAP_NAMES[coefficients] if any(values) or "FISHEYE" in model else "PINHOLE",
        width=width,
        height=height,
        params=(
            fl_x,
            stated.get("fl_y", fl_x),
            stated.get("cx", width / 2),
            stated.get("cy", height / 2),
            *(values if any(values) or "FISHEYE" in model else ()),
        ),
    )
    return check_camera(path, 1, camera)


def _read_size(stated: dict[str, Any], path: Path, image: Path) -> tuple[int, int]:
    """Return width and height for which the camera model is valid; the size of the image if none is stated."""
    if "w" not in stated or "h" not in stated:
        return image_size(image)
    try:
        return int(stated["w"]), int(stated["h"])
    except (ValueError, OverflowError) as error:
        raise MalformedFileError(
            path, f"states the size {stated['w']} x {stated['h']}", "correct it"
        ) from error
