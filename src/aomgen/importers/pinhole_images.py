"""The common pinhole camera of a scan's images, and the resampling of images to it."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
import pycolmap

from aomgen.core.lens import Lens, Resample, resampler
from aomgen.core.values import Array
from aomgen.errors import CalibrationError, SeveralCamerasError
from aomgen.io.colmap_models import ColmapCamera

# Images whose pixels all deviate less than this from the pinhole camera are not resampled, [px].
SAME_PX: Final = 0.05
# Number of points along each side of the image, sufficient because distortion is smooth.
BORDER_SAMPLES: Final = 32
# The focal length of the pinhole camera is searched within this factor of the lens's focal length.
FOCAL_SEARCH: Final = 5.0
# Number of bisections of this range, for a resolution of a thousandth of a pixel.
BISECTIONS: Final = 40
# Largest ratio of focal lengths of images from one camera; autofocus changes the focal length less.
MAX_FOCAL_RATIO: Final = 1.15


def rescale_camera(camera: ColmapCamera, width: int, height: int) -> ColmapCamera:
    """Return the camera model of an image after a change of its size."""
    if (width, height) == (camera.width, camera.height):
        return camera
    changed = _colmap(camera)
    changed.rescale(width, height)
    return ColmapCamera(
        model=camera.model, width=width, height=height, params=tuple(float(value) for value in changed.params)
    )


def choose_pinhole(cameras: Mapping[str, ColmapCamera], where: Path) -> Lens:
    """Choose the pinhole camera, a `Lens` without distortion, to which images of all lenses can be resampled without empty borders.

    A single undistorted lens is kept exactly. Otherwise the principal point is that of the lens with the median focal
    length, and the focal length is the smallest one at which every lens covers every pixel.

    Args:
        cameras: Lenses by image name, for the same image size.
        where: The source, for errors.

    Raises:
        SeveralCamerasError: Focal lengths differ too much.
        CalibrationError: A lens does not cover the image.
    """
    lenses = sorted(set(cameras.values()), key=lambda lens: _focals(lens))
    middle = lenses[len(lenses) // 2]
    low, high = _focals(lenses[0])[0], _focals(lenses[-1])[0]
    if not high <= MAX_FOCAL_RATIO * low:
        groups: dict[str, list[str]] = {}
        for name, lens in cameras.items():
            groups.setdefault(f"focal length {_focals(lens)[0]:.0f} px", []).append(name)
        raise SeveralCamerasError(where, groups)
    colmap = _colmap(middle)
    fx, fy = _focals(middle)
    target = Lens(
        fx=fx,
        fy=fy,
        cx=float(colmap.principal_point_x),
        cy=float(colmap.principal_point_y),
        width=middle.width,
        height=middle.height,
    )
    if all(measure_shift_px(target, lens) <= SAME_PX for lens in lenses):
        return target
    low, high = 1 / FOCAL_SEARCH, FOCAL_SEARCH

    def zoom(share: float) -> Lens:
        return replace(target, fx=share * target.fx, fy=share * target.fy)

    if not _covers(zoom(high), lenses):
        raise CalibrationError(where, "has a lens that does not cover its images", "check the intrinsics")
    for _ in range(BISECTIONS):
        share = (low * high) ** 0.5
        low, high = (low, share) if _covers(zoom(share), lenses) else (share, high)
    return zoom(high)


def measure_shift_px(target: Lens, lens: ColmapCamera) -> float:
    """Compute the largest distance between a pixel of the pinhole camera and its position in the image of a lens, [px]."""
    pixels = _border(target)
    shifts = np.linalg.norm(_project(lens, target.rays(pixels)) - pixels, axis=1)
    return float(np.nan_to_num(shifts, nan=np.inf).max())


@lru_cache(maxsize=2)
def make_resampler(target: Lens, lens: ColmapCamera) -> Resample | None:
    """Return the resampling of images of a lens to those of a pinhole camera; None if no resampling is needed."""
    if measure_shift_px(target, lens) <= SAME_PX:
        return None
    u, v = np.meshgrid(np.arange(target.width) + 0.5, np.arange(target.height) + 0.5)
    pixels = _project(lens, target.rays(np.column_stack([u.ravel(), v.ravel()])))
    return resampler(pixels.reshape(target.height, target.width, 2))


def _covers(target: Lens, lenses: list[ColmapCamera]) -> bool:
    rays = target.rays(_border(target))
    size = np.array([target.width, target.height])
    # Resampling repeats the outermost half pixel.
    return all(
        bool(((pixels >= -0.5) & (pixels <= size + 0.5)).all())
        for pixels in (_project(lens, rays) for lens in lenses)
    )


def _border(target: Lens) -> Array:
    """Sample points on the border and on the diagonals of the image."""
    share: Array = np.linspace(0.0, 1.0, BORDER_SAMPLES, dtype=np.float64)
    zero, one = np.zeros_like(share), np.ones_like(share)
    lines = [(share, zero), (share, one), (zero, share), (one, share), (share, share), (share, 1 - share)]
    return np.concatenate([np.column_stack(line) for line in lines]) * [target.width, target.height]


def _project(lens: ColmapCamera, rays: Array) -> Array:
    """Project rays (N, 2), as x/z, y/z, to image points (N, 2); NaN outside the domain of the lens."""
    points = np.column_stack([rays, np.ones(len(rays))])
    return np.asarray(_colmap(lens).img_from_cam(points), np.float64).reshape(-1, 2)


def _focals(lens: ColmapCamera) -> tuple[float, float]:
    camera = _colmap(lens)
    return float(camera.focal_length_x), float(camera.focal_length_y)


def _colmap(lens: ColmapCamera) -> pycolmap.Camera:
    return pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
