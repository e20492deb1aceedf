"""A folder of photos from a phone or camera: JPEG, PNG or HEIC, with their EXIF data."""

from collections import defaultdict
from math import hypot
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from aomgen.capture.scan_images import FOREIGN_SUFFIXES, IMAGE_SUFFIXES
from aomgen.errors import IncompleteCaptureError, MalformedFileError, SeveralCamerasError
from aomgen.importers.scan_source import ScanImage, ScanSource
from aomgen.io.colmap_models import ColmapCamera
from aomgen.io.heic import HEIC_SUFFIXES, open_heic
from aomgen.io.images import image_size, open_image, read_exif, read_image

# Tag of the EXIF block that contains the focal length.
EXIF_BLOCK: Final = 0x8769
# Tag of the 35 mm equivalent focal length.
FOCAL_35MM: Final = 0xA405
# Image diagonal of a 35 mm camera, [mm].
DIAGONAL_35MM: Final = hypot(36.0, 24.0)
# Largest ratio of focal lengths of one lens: equivalent focal lengths are rounded to millimeters, and a larger ratio
# means another lens or zoom.
MAX_FOCAL_RATIO: Final = 1.08
# Plausible 35 mm equivalents, [mm]; cameras write 0 or 1 for an unknown focal length.
FOCAL_RANGE_35MM: Final = (8.0, 400.0)


def list_photos(source: Path) -> list[Path]:
    """Return the photos of a folder by name; a JPEG or PNG is preferred to a HEIC of the same name.

    Raises:
        MalformedFileError: A photo has another format, and no readable photo has its name.
        IncompleteCaptureError: The folder contains no photos.
    """
    files = sorted(item for item in source.iterdir() if item.is_file() and not item.name.startswith("."))
    plain = [item for item in files if item.suffix.lower() in IMAGE_SUFFIXES]
    stems = {item.stem for item in plain}
    photos = plain + [
        item for item in files if item.suffix.lower() in HEIC_SUFFIXES and item.stem not in stems
    ]
    stems = {item.stem for item in photos}
    foreign = [item for item in files if item.suffix.lower() in FOREIGN_SUFFIXES and item.stem not in stems]
    if foreign:
        raise MalformedFileError(
            foreign[0], "is neither JPEG nor PNG nor HEIC", "export it as JPEG, or remove it"
        )
    if not photos:
        raise IncompleteCaptureError(source, "holds no photos", "give a folder of JPEG, PNG or HEIC files")
    return sorted(photos)


def read_photos(source: Path) -> ScanSource:
    """Read the headers of a folder of photos.

    The focal length is used if all photos state the same one. Photos that were taken with different lenses or zooms
    are refused.

    Raises:
        InputError: See `list_photos` and `read_header`.
        SeveralCamerasError: The focal lengths differ.
    """
    paths = list_photos(source)
    headers = [read_header(path) for path in paths]
    known = [focal for _, focal in headers if focal]
    camera_known = len(known) == len(headers)
    if known and not max(known) <= MAX_FOCAL_RATIO * min(known):
        groups = defaultdict(list)
        for path, (_, focal) in zip(paths, headers, strict=True):
            groups[f"focal length {focal:.0f} px"].append(path.name)
        raise SeveralCamerasError(source, groups)
    focal = float(np.median(known)) if known else 0.0
    images = [
        ScanImage(name=path.name, path=path, camera=_describe_camera(size, focal) if camera_known else None)
        for path, (size, _) in zip(paths, headers, strict=True)
    ]
    return ScanSource(kind="folder of photos", images=tuple(images))


def _describe_camera(size: tuple[int, int], focal: float) -> ColmapCamera:
    width, height = size
    return ColmapCamera(
        model="SIMPLE_PINHOLE", width=width, height=height, params=(focal, width / 2, height / 2)
    )


def read_header(path: Path) -> tuple[tuple[int, int], float]:
    """Read displayed width and height of a photo, and its focal length, [px]; 0 if the photo does not state it.

    Raises:
        InputError, BackendError: See `open_image` and `open_heic`.
    """
    if path.suffix.lower() in HEIC_SUFFIXES:
        image = open_heic(path)
        return image.size, _focal_px(image)
    size = image_size(path)
    with open_image(path) as image:
        return size, _focal_px(image)


def read_photo(path: Path, *, upright: bool = True) -> NDArray[np.uint8]:
    """Decode a photo (H, W, 3) uint8 sRGB, with EXIF's orientation applied if `upright`; HEIC is always upright.

    Raises:
        InputError, BackendError: See `read_image` and `open_heic`.
    """
    if path.suffix.lower() in HEIC_SUFFIXES:
        return np.asarray(open_heic(path).convert("RGB"))
    return read_image(path, upright=upright)


def _focal_px(image: Image.Image) -> float:
    """Compute the focal length of a photo, [px], from its 35 mm equivalent; 0 if the photo does not state it."""
    stated = read_exif(image).get_ifd(EXIF_BLOCK).get(FOCAL_35MM, 0)
    try:
        focal_mm = float(stated)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    if not FOCAL_RANGE_35MM[0] <= focal_mm <= FOCAL_RANGE_35MM[1]:
        return 0.0
    return focal_mm / DIAGONAL_35MM * hypot(image.width, image.height)
