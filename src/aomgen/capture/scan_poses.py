"""Poses of scan images that another program found: `scan_poses.json` in the folder of the images."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aomgen.core.recording import ScanPoses
from aomgen.core.transforms import ROTATION_TOLERANCE, measure_rigidity
from aomgen.core.values import Array
from aomgen.errors import MalformedFileError, NonFiniteError, ScanPoseError
from aomgen.io.artifact import read_json
from aomgen.io.schema import complaint

SCAN_POSES_FILE: Final = "scan_poses.json"
Row = Annotated[list[float], Field(min_length=4, max_length=4)]


class ScanPosesFile(BaseModel):
    """Content of `scan_poses.json`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1]
    metric: bool = False
    T_scan_cam: dict[str, Annotated[list[Row], Field(min_length=4, max_length=4)]]


def read_scan_poses(path: Path) -> ScanPoses:
    """Read and check the poses of a scan.

    Raises:
        MalformedFileError: The file does not follow its format.
        NonFiniteError, ScanPoseError: See `require_pose`.
    """
    data = read_json(path)
    try:
        stored = ScanPosesFile.model_validate(data)
    except ValidationError as error:
        raise MalformedFileError(path, *complaint(error, ScanPosesFile)) from error
    poses = {name: require_pose(np.array(rows), path, name) for name, rows in stored.T_scan_cam.items()}
    return ScanPoses(Ts_scan_cam=poses, metric=stored.metric)


def describe_scan_poses(poses: ScanPoses) -> Mapping[str, object]:
    """Return the content of the file that holds these poses."""
    return {
        "format": 1,
        "metric": poses.metric,
        "T_scan_cam": {name: T.tolist() for name, T in poses.Ts_scan_cam.items()},
    }


def require_pose(T_scan_cam: Array, path: Path, image: str) -> Array:
    """Return the pose (4, 4) of an image after a check, with an exact rotation.

    Raises:
        NonFiniteError: A number is NaN or infinite.
        ScanPoseError: It is not a rotation with a translation, for example a reflection.
    """
    if not np.isfinite(T_scan_cam).all():
        raise NonFiniteError(path, f"the pose of {image} has a number that is not finite", "export it again")
    determinant, deviation = measure_rigidity(T_scan_cam)
    bottom = np.abs(T_scan_cam[3] - [0, 0, 0, 1]).max()
    if not (determinant > 0 and max(deviation, bottom) <= ROTATION_TOLERANCE):
        raise ScanPoseError(path, image, determinant, max(deviation, float(bottom)))
    # The nearest rotation: files hold few digits.
    U, _, Vt = np.linalg.svd(T_scan_cam[:3, :3])
    exact = T_scan_cam.copy()
    exact[:3, :3] = U @ Vt
    return exact
