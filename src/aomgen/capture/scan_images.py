"""The images of a scan: which files they are, their common size, and whether they can be decoded and are sharp."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from aomgen.core.recording import Recording, frame_name
from aomgen.errors import CalibrationError, IncompleteCaptureError, MalformedFileError
from aomgen.io.images import exif_orientation, image_size, open_image, to_eight_bits
from aomgen.io.video import decode_frames, probe_video

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
# Other formats of phones and cameras. One of these without a readable copy is an image left out.
FOREIGN_SUFFIXES = (
    ".heic", ".heif", ".avif", ".webp", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2",
    ".tif", ".tiff", ".bmp", ".jxl", ".exr",
)  # fmt: skip
# Fewer than this leave sides of the object that no three views see.
MIN_SCAN_IMAGES = 12
# Images are compared at this width, [px]: a blur there is one that the reconstruction sees too.
WIDTH: Final = 320
# Number of neighbours that the low pass averages, [px].
TAPS: Final = 5
# Rows, columns and both diagonals: an image blurred along one is sharp across it.
DIRECTIONS: Final = ((0, 1), (1, 0), (1, 1), (1, -1))
# Measured on twelve captures: 0.37 to 0.57 as they are; blurred at 640 px width 0.78 to 1 (Gaussian of
# 3 to 6 px, motion of 15 px along a row, a column or a diagonal), from 0.76 with sensor noise of 2 grey
# levels after it. A Gaussian of 1.5 px, which a reconstruction bears, gives 0.64 to 0.74.
BLURRED: Final = 0.70
# From a Gaussian of 3 px on: features are gone that a reconstruction needs.
HOPELESS: Final = 0.80
# Differences of neighbours below this, root mean square in grey levels, are noise on an empty image
# (a covered lens); the twelve captures have 7 and more.
MIN_DETAIL: Final = 2.5
# With a larger share of hopeless images than this, too few others are left anywhere.
MAX_HOPELESS_SHARE = 0.8
# Number of frames of a scan video that are checked: it is hand-held, and only sharp frames are used later.
VIDEO_LOOKS = 60
# A sensor's 12 bits stored in 16 without scaling stay below this, and so does no image that shows anything.
LEAST_16_BITS: Final = 4096
# Names in one sentence; the rest is counted.
SHOWN_NAMES = 5


def find_images(scan: Path) -> tuple[Path, ...]:
    """List the JPEG and PNG files of a folder by name; hidden files are ignored.

    Raises:
        MalformedFileError: An image of another format, without a JPEG or PNG of its name.
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
            foreign[0], f"is neither JPEG nor PNG{more}", "export it as JPEG, or remove it from the scan"
        )
    if not images:
        _refuse_subfolders(scan)
    if not len(images) >= MIN_SCAN_IMAGES:
        raise IncompleteCaptureError(
            scan,
            f"holds {len(images)} images, at least {MIN_SCAN_IMAGES} are needed",
            "scan from more viewpoints",
        )
    return images


def _refuse_subfolders(scan: Path) -> None:
    """Name the folders below a folder without images that hold some."""
    below = sorted({item.parent for item in scan.rglob("*") if item.suffix.lower() in IMAGE_SUFFIXES})
    below = [item for item in below if not any(part.startswith(".") for part in item.relative_to(scan).parts)]
    if below:
        names = ", ".join(str(item.relative_to(scan)) for item in below[:SHOWN_NAMES])
        raise IncompleteCaptureError(
            scan,
            f"contains no images, but its subfolders do ({names})",
            "put all images into one folder, or name the subfolder in scan.images",
        )


def common_size(images: tuple[Path, ...]) -> tuple[int, int]:
    """Return the width and height of all images, [px].

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
                f"is {size[0]} x {size[1]}, but {images[0].name} is {first[0]} x {first[1]}{_describe_rotated(images)}",
                "export all scan images at one size, upright",
            )
    return first


def _describe_rotated(images: Sequence[Path]) -> str:
    """Write the end of a sentence that names the images that EXIF rotates; empty without any."""
    turned = []
    for path in images:
        with open_image(path) as image:
            if exif_orientation(image) > 1:
                turned.append(path.name)
    return f"; EXIF data rotates {len(turned)} of {len(images)} images ({_some(turned)})" if turned else ""


def check_scan(capture: Recording) -> tuple[int, list[str]]:
    """Decode the whole scan.

    Returns:
        Number of stills or frames, and warnings.

    Raises:
        MalformedFileError: An image or the video is damaged or truncated.
        IncompleteCaptureError: Nearly all images are hopelessly blurred.
    """
    if capture.scan_video is not None:
        count, blurs = _video_blurs(capture.scan_video)
        _refuse_hopeless(capture.scan_video, blurs)
        return count, []
    blurs = {path.name: blur(read_grey(path)) for path in capture.scan_images}
    warnings = []
    turned = _describe_rotated(capture.scan_images)
    if turned:
        width, height = capture.scan_size
        warnings.append(
            f"{capture.scan_images[0].parent}{turned}; prompts and intrinsics must refer to "
            f"the {width} x {height} image"
        )
    _refuse_hopeless(capture.scan_images[0].parent, blurs)
    blurred = _beyond(BLURRED, blurs)
    if blurred:
        warnings.append(
            f"{len(blurred)} of {len(blurs)} scan images are blurred ({_some(blurred)}): remove them, or scan again"
        )
    return len(blurs), warnings


def _video_blurs(path: Path) -> tuple[int, dict[str, float]]:
    stride = max(1, probe_video(path).frames // VIDEO_LOOKS)
    count, blurs = 0, {}
    for _, frame in decode_frames(path):
        if count % stride == 0:
            blurs[frame_name(count)] = blur(shrink(frame.to_image()))
        count += 1
    return count, blurs


def _refuse_hopeless(where: Path, blurs: dict[str, float]) -> None:
    blurred = _beyond(HOPELESS, blurs)
    if not len(blurred) <= MAX_HOPELESS_SHARE * len(blurs):
        raise IncompleteCaptureError(
            where,
            f"{len(blurred)} of {len(blurs)} sampled images are blurred ({_some(blurred)})",
            "scan again in focus and with more light, and stand still for each image",
        )


def _beyond(limit: float, blurs: dict[str, float]) -> list[str]:
    return [name for name, value in blurs.items() if value > limit]


def _some(names: Sequence[str]) -> str:
    more = f", {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else ""
    return ", ".join(names[:SHOWN_NAMES]) + more


def blur(grey: NDArray[np.floating]) -> float:
    """Compute the share of an image's neighbor differences (root mean square) that a low-pass filter preserves, 0..1.

    A low-pass filter removes much detail from a sharp image and little from a blurred one. The result is the largest of four
    directions, because motion blurs along one direction only. An image without detail has 1.

    Args:
        grey: (H, W), grey levels 0..255, at most `WIDTH` wide.

    Source: the re-blur comparison of Crete et al. 2007, doi:10.1117/12.702790, with squares in place of
    absolute values, so that edges count more than noise, and with both diagonals.
    """
    return max(_left(grey, *direction) for direction in DIRECTIONS)


def read_grey(path: Path) -> NDArray[np.float32]:
    """Decode an image completely, as gray levels (H, W) at most `WIDTH` wide.

    Raises:
        MissingFileError, LimitExceededError: The file is missing or too large.
        MalformedFileError: It is no image, damaged or truncated.
    """
    with open_image(path) as image:
        try:
            # A JPEG is decoded at the smallest sufficient scale, which saves most of the time.
            image.draft("L", (2 * WIDTH, 2 * WIDTH))
            image.load()
        except (OSError, ValueError, SyntaxError) as error:
            raise MalformedFileError(
                path, f"cannot be decoded ({error})", "copy or export it again"
            ) from error
        if image.mode.startswith("I") and not np.asarray(image).max() >= LEAST_16_BITS:
            raise MalformedFileError(
                path, f"holds values up to {np.asarray(image).max()} of 16 bits, so it is black",
                "export it scaled to 16 bits, or with 8 bits",
            )  # fmt: skip
        return shrink(to_eight_bits(image))


def shrink(image: Image.Image) -> NDArray[np.float32]:
    """Convert an image to gray levels (H, W), at most `WIDTH` wide."""
    grey = image.convert("L")
    if grey.width > WIDTH:
        size = (WIDTH, max(1, round(grey.height * WIDTH / grey.width)))
        grey = grey.resize(size, Image.Resampling.BOX)
    return np.asarray(grey, np.float32)


def _left(grey: NDArray[np.floating], down: int, right: int) -> float:
    half = TAPS // 2
    edge = half + 1
    height, width = grey.shape

    def move(steps: int) -> NDArray[np.floating]:
        y, x = edge + steps * down, edge + steps * right
        return grey[y : y + height - 2 * edge, x : x + width - 2 * edge]

    fine = move(1) - move(0)
    # The difference of two neighbouring averages is that of their ends.
    coarse = (move(half + 1) - move(-half)) / TAPS
    detail = float(np.sqrt(np.mean(fine**2)))
    return float(np.sqrt(np.mean(coarse**2))) / detail if detail > MIN_DETAIL else 1.0
