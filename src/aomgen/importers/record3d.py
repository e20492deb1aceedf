"""Record3D's export: a folder of numbered frames (JPEG or PNG, with EXR depth files) and metadata.json."""

from pathlib import Path
from typing import Annotated, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aomgen.capture.scan_images import blur, read_grey
from aomgen.core.transforms import matrix_from_quat, transform
from aomgen.errors import IncompleteCaptureError, MalformedFileError, MissingFileError, NonFiniteError
from aomgen.importers.scan_source import ScanImage, ScanSource, read_opengl_pose
from aomgen.io.artifact import read_json
from aomgen.io.colmap_models import ColmapCamera, check_camera
from aomgen.io.schema import complaint

METADATA_FILES: Final = ("metadata.json", "metadata")
FRAME_FOLDERS: Final = ("rgb", "EXR_RGBD/rgb", "rgbd", ".")
# Largest number of used frames: frames are recorded at video rate, and the sharpest one of each of equal spans is used.
MAX_FRAMES: Final = 120


class RecordMetadata(BaseModel):
    """Fields of Record3D's metadata that are used.

    Attributes:
        K: Intrinsic matrix, 9 numbers by columns.
        poses: Quaternion xyzw and position of every frame, OpenGL axes, [m].
        intrinsics: fx, fy, cx, cy of every frame, if they differ.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    K: Annotated[list[float], Field(min_length=9, max_length=9)]
    w: int
    h: int
    poses: list[Annotated[list[float], Field(min_length=7, max_length=7)]]
    intrinsics: list[Annotated[list[float], Field(min_length=4, max_length=4)]] = Field(
        default=[], alias="perFrameIntrinsicCoeffs"
    )


def find_metadata(source: Path) -> Path | None:
    """Return the path of Record3D's metadata in a source; None if there are none."""
    for name in METADATA_FILES:
        for folder in (source, source / "EXR_RGBD"):
            if (folder / name).is_file():
                return folder / name
    return None


def read_record3d(source: Path) -> ScanSource:
    """Read frames, poses and intrinsics of a Record3D export; depth is not used.

    Raises:
        MissingFileError: The metadata or the frames are missing.
        MalformedFileError, NonFiniteError, CalibrationError: The metadata are invalid.
        IncompleteCaptureError: The numbers of frames and poses differ, so that they cannot be associated.
    """
    path = find_metadata(source)
    if path is None:
        raise MissingFileError(source, "holds no metadata of Record3D", "export it as EXR + RGB")
    data = read_json(path)
    try:
        stored = RecordMetadata.model_validate(data)
    except ValidationError as error:
        raise MalformedFileError(path, *complaint(error, RecordMetadata)) from error
    files = _find_frames(path.parent)
    for name, values in (("poses", stored.poses), ("intrinsics", stored.intrinsics or files)):
        if len(values) != len(files):
            raise IncompleteCaptureError(
                path, f"holds {len(values)} {name} for {len(files)} frames", "export the recording again"
            )
    kept = _choose_sharp(files)
    images = [_read_frame(stored, index, files[index], path) for index in kept]
    left_out = f"took the sharpest {len(kept)} of {len(files)} frames"
    return ScanSource(
        kind="Record3D export",
        images=tuple(images),
        metric=True,
        warnings=(left_out,) if len(kept) < len(files) else (),
    )


def _find_frames(folder: Path) -> list[Path]:
    for name in FRAME_FOLDERS:
        files = [
            path
            for path in (folder / name).glob("*")
            if path.suffix.lower() in (".jpg", ".jpeg", ".png") and path.stem.isdecimal()
        ]
        if files:
            return sorted(files, key=lambda path: int(path.stem))
    raise MissingFileError(folder, "holds no numbered frames", "export it as EXR + RGB")


def _choose_sharp(files: list[Path]) -> list[int]:
    """Return the numbers of the sharpest frames of at most `MAX_FRAMES` equal spans."""
    if len(files) <= MAX_FRAMES:
        return list(range(len(files)))
    spans = np.array_split(np.arange(len(files)), MAX_FRAMES)
    return [int(min(span, key=lambda index: blur(read_grey(files[index])))) for span in spans]


def _read_frame(stored: RecordMetadata, index: int, file: Path, path: Path) -> ScanImage:
    K = np.array(stored.K).reshape(3, 3).T
    params = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    if stored.intrinsics:
        params = tuple(stored.intrinsics[index])
    camera = ColmapCamera(
        model="PINHOLE", width=stored.w, height=stored.h, params=tuple(float(value) for value in params)
    )
    x, y, z, w, *position = stored.poses[index]
    name = f"{index:05d}{file.suffix}"
    if not (np.isfinite(stored.poses[index]).all() and np.linalg.norm([w, x, y, z]) > 1e-6):
        raise NonFiniteError(path, f"pose {index} is {stored.poses[index]}", "export the recording again")
    matrix = transform(matrix_from_quat([w, x, y, z]), position)
    return ScanImage(
        name=name,
        path=file,
        camera=check_camera(path, 1, camera),
        T_scan_cam=read_opengl_pose(matrix, path, name),
    )
