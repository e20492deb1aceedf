"""Reader of a COLMAP project folder of undistorted pinhole images: cameras, points and images.

Binary models of any COLMAP version are read. COLMAP and AOMGen share their conventions: pixel centers
lie at +0.5, and cameras look along +z with y down.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import CalibrationError, NonFiniteError
from aomgen.io.colmap_binary import read_cameras_bin, read_images_bin, read_points_bin
from aomgen.io.colmap_models import REMEDY, ColmapImage
from aomgen.io.images import image_size
from aomgen.io.paths import resolve_inside


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapView:
    """A registered image.

    Attributes:
        camera_recon: Camera in the `recon` frame, scaled to the size of the image file.
        path: Image file.
    """

    camera_recon: Camera
    path: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapModel:
    """A sparse reconstruction in COLMAP's own frame, whose scale and orientation are arbitrary.

    Attributes:
        views: Registered images by file name, in name order.
        points_recon: Points (P, 3).
        colors_srgb: Colors of the points (P, 3) uint8.
        observations: Observations (M, 2) int32; a row is (index of the point, index of the view in `views`).
    """

    views: dict[str, ColmapView]
    points_recon: Annotated[Array, "P 3"]
    colors_srgb: Annotated[NDArray[np.uint8], "P 3"]
    observations: Annotated[NDArray[np.int32], "_ 2"]

    __post_init__ = freeze_arrays


def read_colmap(folder: Path, *, images: str = "images") -> ColmapModel:
    """Read the model in `folder/sparse/0` or `folder/sparse`, and find its images.

    Images may be resized copies of the reconstructed ones (`images_4`); the cameras are scaled to the
    size of the image files.

    Args:
        folder: COLMAP project, as `colmap image_undistorter` writes it.
        images: Name of the folder of images, inside `folder`.

    Raises:
        MissingFileError: There is no binary model, or an image is missing.
        MalformedFileError: A file of the model is damaged or contradicts another.
        NonFiniteError: A number of the model is NaN or infinite.
        LimitExceededError: A file is larger than 4 GiB.
        CalibrationError: A camera has lens distortion, or an image has another aspect ratio than its camera.
        UnsafePathError: The name of an image leaves the folder of images.

    Not checked: that the images are the ones that were reconstructed.
    """
    model = folder / "sparse" / "0"
    if not model.is_dir():
        model = folder / "sparse"
    file = model / "images.bin"
    posed = read_images_bin(file, read_cameras_bin(model / "cameras.bin"))
    views = {}
    for image in sorted(posed, key=lambda image: image.name):
        path = resolve_inside(folder / images, image.name, named_by=file)
        camera = _pinhole_camera(image, model / "cameras.bin")
        views[image.name] = ColmapView(camera_recon=_fit(camera, path), path=path)
    order = {name: index for index, name in enumerate(views)}
    points, colors, observations = read_points_bin(
        model / "points3D.bin", {image.number: order[image.name] for image in posed}
    )
    return ColmapModel(views=views, points_recon=points, colors_srgb=colors, observations=observations)


def _pinhole_camera(image: ColmapImage, path: Path) -> Camera:
    camera = image.camera
    if camera.model not in ("SIMPLE_PINHOLE", "PINHOLE"):
        raise CalibrationError(
            path,
            f"the camera of {image.name} has the model {camera.model}, expected PINHOLE",
            "run `colmap image_undistorter`",
        )
    *focal_lengths, cx, cy = camera.params
    fx, fy = focal_lengths[0], focal_lengths[-1]
    if not fy > 0:
        raise NonFiniteError(path, f"the camera of {image.name} has the focal lengths {fx:g}, {fy:g}", REMEDY)
    return Camera(
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        width=camera.width,
        height=camera.height,
        T_world_cam=image.T_recon_cam,
    )


def _fit(camera: Camera, path: Path) -> Camera:
    """Scale a camera to the size of its image file; raises CalibrationError if the aspect ratios differ."""
    width, height = image_size(path)
    if not abs(width * camera.height - height * camera.width) <= 1.01 * max(camera.width, camera.height):
        raise CalibrationError(
            path,
            f"is {width} x {height}, its camera {camera.width} x {camera.height}: another shape",
            "use the images that were reconstructed",
        )
    return camera.resize(width, height)
