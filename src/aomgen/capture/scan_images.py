"""The stills of a scan: which files they are, and their common size."""

from pathlib import Path

from aomgen.errors import CalibrationError, IncompleteCaptureError, MalformedFileError
from aomgen.io.images import image_size

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
# What phones and cameras write otherwise. One of these without a readable copy is an image left out.
FOREIGN_SUFFIXES = (
    ".heic", ".heif", ".avif", ".webp", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2",
    ".tif", ".tiff", ".bmp", ".jxl", ".exr",
)  # fmt: skip
# Fewer than this leave sides of the object that no three views see.
MIN_SCAN_IMAGES = 12


def find_images(scan: Path) -> tuple[Path, ...]:
    """JPEG and PNG files of a folder in the order of their names; hidden ones are passed over.

    Raises:
        MalformedFileError: An image of another format, without a JPEG or PNG of its name beside it.
        IncompleteCaptureError: Fewer than are needed.
    """
    files = sorted(item for item in scan.iterdir() if not item.name.startswith("."))
    images = tuple(item for item in files if item.suffix.lower() in IMAGE_SUFFIXES)
    readable = {item.stem for item in images}
    foreign = [
        item for item in files if item.suffix.lower() in FOREIGN_SUFFIXES and item.stem not in readable
    ]
    if foreign:
        more = f" (and {len(foreign) - 1} more)" if len(foreign) > 1 else ""
        raise MalformedFileError(
            foreign[0], f"is neither JPEG nor PNG{more}", "export it as JPEG, or take it out of the scan"
        )
    if not len(images) >= MIN_SCAN_IMAGES:
        raise IncompleteCaptureError(
            scan,
            f"holds {len(images)} images, at least {MIN_SCAN_IMAGES} are needed",
            "scan from more viewpoints",
        )
    return images


def common_size(images: tuple[Path, ...]) -> tuple[int, int]:
    """Width and height that all images have, [px].

    Raises:
        CalibrationError: One has another size than the first.
        MalformedFileError: One is not an image.
    """
    first = image_size(images[0])
    for image in images[1:]:
        size = image_size(image)
        if size != first:
            raise CalibrationError(
                image,
                f"is {size[0]} x {size[1]}, but {images[0].name} is {first[0]} x {first[1]}",
                "export all scan images at one size",
            )
    return first
