"""A scan from another program or a phone: images, camera models, and poses if they are known."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import ArrayLike

from aomgen.capture.scan_poses import require_pose
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.errors import MalformedFileError
from aomgen.io.colmap_models import ColmapCamera

# Signs of the columns of a pose that convert OpenGL's camera axes (x right, y up, z backward) to OpenCV's (x right,
# y down, z forward).
OPENCV_FROM_OPENGL = np.array([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanImage:
    """One image of a scan.

    Attributes:
        name: File name of the image in the capture; its suffix may still change.
        camera: Camera model of the image; None if it is unknown.
        T_scan_cam: Pose (4, 4), OpenCV axes; None if it is unknown.
    """

    name: str
    path: Path
    camera: ColmapCamera | None = None
    T_scan_cam: Matrix4 | None = None

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanSource:
    """A scan as provided by its source.

    Attributes:
        kind: Name of the format, for example "COLMAP model".
        metric: Whether poses are in meters.
        warnings: Sentences about data that the reader ignored.
    """

    kind: str
    images: tuple[ScanImage, ...]
    metric: bool = False
    warnings: tuple[str, ...] = ()


def read_opengl_pose(matrix: ArrayLike, path: Path, image: str) -> Array:
    """Return T_scan_cam (4, 4) with OpenCV axes from a camera-to-world matrix with OpenGL axes.

    Args:
        matrix: (3, 4) or (4, 4).
        path, image: File and image of the pose, for errors.

    Raises:
        MalformedFileError: The matrix has another shape.
        NonFiniteError, ScanPoseError: See `require_pose`.
    """
    try:
        T_scan_cam = np.array(matrix, np.float64)
    except (TypeError, ValueError):
        T_scan_cam = np.zeros(0)
    if T_scan_cam.shape == (3, 4):
        T_scan_cam = np.vstack([T_scan_cam, [0.0, 0.0, 0.0, 1.0]])
    if T_scan_cam.shape != (4, 4):
        raise MalformedFileError(path, f"the pose of {image} is not a 4 x 4 matrix", "export it again")
    return require_pose(T_scan_cam * OPENCV_FROM_OPENGL, path, image)


def name_images(references: Sequence[str], path: Path) -> list[str]:
    """Return names without folders for images that a file references by their paths.

    If images in several folders have the same name, the folders become part of their names.

    Raises:
        MalformedFileError: Two names are equal.
    """
    parts = [
        [part for part in PurePosixPath(item).parts if part not in (".", "..", "/")] for item in references
    ]
    plain = [names[-1] if names else "" for names in parts]
    names = plain if len(set(plain)) == len(plain) else ["_".join(item) for item in parts]
    name, count = Counter(names).most_common(1)[0] if names else ("-", 1)
    if count > 1 or not name:
        raise MalformedFileError(path, f"names the image '{name}' {count} times", "list every image once")
    return names


def describe_missing_poses(images: Sequence[ScanImage]) -> tuple[str, ...]:
    """Return a warning that names the images without a pose, if others have one."""
    without = [image.name for image in images if image.T_scan_cam is None]
    if not without or len(without) == len(images):
        return ()
    more = " and others" if len(without) > 3 else ""
    return (f"{len(without)} of {len(images)} images have no pose ({', '.join(without[:3])}{more})",)
