"""Polycam's raw export: `keyframes/corrected_images` and `keyframes/corrected_cameras`."""

from pathlib import Path
from typing import Any, Final

from aomgen.capture.scan_images import IMAGE_SUFFIXES
from aomgen.errors import MalformedFileError, MissingFileError
from aomgen.importers.scan_source import ScanImage, ScanSource, describe_missing_poses, read_opengl_pose
from aomgen.io.artifact import read_json
from aomgen.io.colmap_models import ColmapCamera, check_camera
from aomgen.io.images import image_size

# Pairs of folders of images and cameras; the corrected ones exist if Polycam has refined the poses.
FOLDERS: Final = (("corrected_images", "corrected_cameras"), ("images", "cameras"))
POSE_KEYS: Final = tuple(tuple(f"t_{row}{column}" for column in range(4)) for row in range(3))
INTRINSIC_KEYS: Final = ("fx", "fy", "cx", "cy")


def find_keyframes(source: Path) -> Path | None:
    """Return the folder of keyframes in a source; None if there is none."""
    for folder in (source, source / "keyframes"):
        if any((folder / images).is_dir() and (folder / cameras).is_dir() for images, cameras in FOLDERS):
            return folder
    return None


def read_polycam(source: Path) -> ScanSource:
    """Read the keyframes of Polycam's raw export; poses are metric, depth maps are not used.

    Raises:
        MissingFileError: There are no keyframes.
        MalformedFileError, CalibrationError, NonFiniteError, ScanPoseError: The file of a camera is invalid.
    """
    keyframes = find_keyframes(source)
    if keyframes is None:
        raise MissingFileError(
            source, "holds no keyframes of Polycam", "export it in developer mode as raw data"
        )
    for images_name, cameras_name in FOLDERS:
        found = sorted((keyframes / images_name).glob("[!.]*"))
        files = [path for path in found if path.suffix.lower() in IMAGE_SUFFIXES]
        if files:
            images = [_read_image(path, keyframes / cameras_name / f"{path.stem}.json") for path in files]
            return ScanSource(
                kind="Polycam raw export",
                images=tuple(images),
                metric=True,
                warnings=describe_missing_poses(images),
            )
    raise MissingFileError(keyframes, "holds no images", "export the raw data again")


def _read_image(path: Path, camera_file: Path) -> ScanImage:
    if not camera_file.is_file():
        return ScanImage(name=path.name, path=path)
    data = read_json(camera_file)
    keys = [key for row in POSE_KEYS for key in row] + list(INTRINSIC_KEYS)
    wrong = [key for key in keys if not _is_number(data.get(key))] if isinstance(data, dict) else keys
    if wrong:
        raise MalformedFileError(camera_file, f"states no number '{wrong[0]}'", "export the raw data again")
    width, height = (data.get(key) for key in ("width", "height"))
    if not (isinstance(width, int) and isinstance(height, int)):
        width, height = image_size(path)
    camera = ColmapCamera(
        model="PINHOLE", width=width, height=height, params=tuple(float(data[key]) for key in INTRINSIC_KEYS)
    )
    matrix = [[data[key] for key in row] for row in POSE_KEYS]
    return ScanImage(
        name=path.name,
        path=path,
        camera=check_camera(camera_file, 1, camera),
        T_scan_cam=read_opengl_pose(matrix, camera_file, path.name),
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
