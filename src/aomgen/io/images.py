"""Reading and writing of images as sRGB arrays; the size in the header is checked before memory is allocated."""

import io
import struct
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageOps, UnidentifiedImageError
from scipy.spatial import ConvexHull, QhullError

from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError
from aomgen.io.atomic import write_bytes

# EXIF tag of the orientation, and the smallest of the values that exchange width and height.
EXIF_ORIENTATION, FIRST_TRANSPOSED = 0x0112, 5
# Largest image that is decoded, [px]; common cameras have fewer pixels.
MAX_PIXELS = 100_000_000
# Ratio of the largest 16-bit to the largest 8-bit value. Pillow clips 16-bit values at 255 instead of scaling them.
SCALE_16_BITS: Final = 257
Mode = Literal["RGB", "RGBA"]


def image_size(path: Path) -> tuple[int, int]:
    """Read width and height, [px], after the EXIF rotation, from the header of an image file.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: The file is missing, malformed or too large.
    """
    with open_image(path) as image:
        transposed = exif_orientation(image) >= FIRST_TRANSPOSED
        return (image.height, image.width) if transposed else (image.width, image.height)


def read_exif(image: Image.Image) -> Image.Exif:
    """Return the EXIF data of an image; they are empty if the image has none or they are damaged."""
    try:
        return image.getexif()
    except (SyntaxError, struct.error):
        return Image.Exif()


def exif_orientation(image: Image.Image) -> int:
    """Return the EXIF orientation of an image, 1 (as stored) to 8; 1 if it is missing or outside this range."""
    orientation = read_exif(image).get(EXIF_ORIENTATION, 1)
    return orientation if orientation in range(1, 9) else 1


def to_eight_bits(image: Image.Image) -> Image.Image:
    """Convert an image to 8 bits per channel; 16-bit values are scaled, which Pillow's own conversion does not do."""
    if not image.mode.startswith("I"):
        return image
    return Image.fromarray((np.asarray(image) // SCALE_16_BITS).clip(0, 255).astype(np.uint8))


def read_image(path: Path, mode: Mode = "RGB", *, upright: bool = True) -> NDArray[np.uint8]:
    """Read an image file to an array (H, W, 3 or 4) uint8, sRGB.

    Args:
        path: Image file in any format that Pillow reads.
        mode: Channels of the result.
        upright: Apply the EXIF rotation.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: The file is missing, malformed or too large.
    """
    with open_image(path) as image:
        return _pixels(image, path, mode, upright=upright)


def decode_image(data: bytes, where: Path, mode: Mode = "RGB") -> NDArray[np.uint8]:
    """Decode the bytes of an image file to an array (H, W, 3 or 4) uint8, sRGB, with the EXIF rotation applied.

    Args:
        data: Content of an image file.
        where: File that contains the bytes, for messages.
        mode: Channels of the result.

    Raises:
        MalformedFileError, LimitExceededError: The file is malformed or too large.
    """
    with _check(io.BytesIO(data), where) as image:
        return _pixels(image, where, mode)


def _pixels(image: Image.Image, where: Path, mode: Mode, *, upright: bool = True) -> NDArray[np.uint8]:
    try:
        turned = ImageOps.exif_transpose(image) if upright and exif_orientation(image) > 1 else image
        return np.asarray(to_eight_bits(turned).convert(mode))
    except (OSError, ValueError, SyntaxError) as error:
        raise MalformedFileError(where, f"cannot be decoded ({error})", "export it again") from error


def opacity_of(image_rgba: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the opacity (H, W) of an image (H, W, 4): its alpha, or the mean of its colors if alpha is 255 everywhere."""
    alpha = image_rgba[..., 3]
    return alpha if alpha.min() < 255 else image_rgba[..., :3].mean(-1).astype(np.uint8)


def read_labels(path: Path) -> NDArray[np.uint8]:
    """Read a label image (H, W) uint8 from an image file with one channel or a palette.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: The file is missing, malformed or too large.
    """
    with open_image(path) as image:
        if image.mode not in ("L", "P", "1"):
            raise MalformedFileError(
                path, f"has mode {image.mode}, expected one 8-bit channel", "export labels as PNG"
            )
        try:
            return np.asarray(image if image.mode != "1" else image.convert("L"), np.uint8)
        except (OSError, ValueError, SyntaxError) as error:
            raise MalformedFileError(path, f"cannot be decoded ({error})", "export it again") from error


def encode_png(image: NDArray[np.uint8] | NDArray[np.uint16], level: int = 6) -> bytes:
    """Encode an image (H, W, 3 or 4) uint8, or one channel (H, W) uint8 or uint16, as PNG.

    Args:
        image: Image to encode.
        level: Compression level, from 0 (fastest) to 9 (smallest).

    Returns:
        Content of a PNG file.
    """
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", compress_level=level)
    return buffer.getvalue()


def encode_jpeg(image: NDArray[np.uint8], quality: int = 90, *, halve_colors: bool = True) -> bytes:
    """Encode an image (H, W, 3) uint8 as JPEG.

    Args:
        image: Image to encode.
        quality: JPEG quality, 1 to 95.
        halve_colors: Store the chroma at half resolution (4:2:0).

    Returns:
        Content of a JPEG file.
    """
    buffer = io.BytesIO()
    Image.fromarray(image).save(
        buffer, "JPEG", quality=quality, subsampling="4:2:0" if halve_colors else "4:4:4"
    )
    return buffer.getvalue()


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an image (H, W, 3) uint8 as JPEG if the suffix is .jpg or .jpeg, and as PNG otherwise.

    Raises:
        StorageError: Writing to the disk failed.
    """
    write_bytes(path, encode_jpeg(image) if path.suffix.lower() in (".jpg", ".jpeg") else encode_png(image))


def resize(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Resize an image to `width` x `height` pixels by averaging over areas."""
    return np.array(Image.fromarray(image).resize((width, height), Image.Resampling.BOX))


def open_image(path: Path) -> Image.Image:
    """Open an image file and check its header, without decoding its pixels.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: The file is missing, malformed or too large.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "check the folder")
    return _check(path, path)


def _check(source: Path | io.BytesIO, where: Path) -> Image.Image:
    try:
        image = Image.open(source)
    except (UnidentifiedImageError, OSError, Image.DecompressionBombError) as error:
        raise MalformedFileError(where, "is not an image", "export it as PNG or JPEG") from error
    if not image.width * image.height <= MAX_PIXELS:
        raise LimitExceededError(where, f"has {image.width} x {image.height} pixels, limit {MAX_PIXELS}")
    return image


def fill_hull(points_px: NDArray[np.floating], width: int, height: int) -> NDArray[np.bool_]:
    """Fill the convex hull of points (N, 2), [px]; the mask (height, width) is empty if they are collinear or fewer than three."""
    image = Image.new("1", (width, height))
    try:
        outline = points_px[ConvexHull(points_px).vertices]
    except QhullError:
        return np.zeros((height, width), bool)
    ImageDraw.Draw(image).polygon([(float(x), float(y)) for x, y in outline], fill=1)
    return np.asarray(image, bool)
