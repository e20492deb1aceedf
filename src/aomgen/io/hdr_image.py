"""Reader of environment maps (HDRIs) in the formats Radiance .hdr and portable float map .pfm, with PyAV."""

from pathlib import Path
from typing import Final

import av
import av.error
import numpy as np
from numpy.typing import NDArray

from aomgen.core.environment_map import EnvironmentMap
from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError, NonFiniteError

# Largest image that is decoded, [px]. "4k" HDRIs have this size; nine harmonics need far fewer pixels.
MAX_PIXELS: Final = 4096 * 2048
# Decoders that refuse a truncated file; the OpenEXR decoder returns black pixels instead.
DECODERS: Final = ("hdr", "pfm")
CONVERT: Final = "save it as a Radiance .hdr file"
SMALLER: Final = "use a version of at most 4096 x 2048 pixels"


def read_environment(path: Path) -> EnvironmentMap:
    """Read an equirectangular environment map; see `EnvironmentMap` for its axes.

    Args:
        path: Radiance .hdr or .pfm file of at most `MAX_PIXELS` pixels.

    Raises:
        MissingFileError, LimitExceededError: The file is missing or too large.
        MalformedFileError: The file is not such an image or is truncated, its width is not twice its height, a value is
            negative, or all values are zero.
        NonFiniteError: A value is NaN or infinite.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "set `light` to the path of an .hdr file")
    radiance = _decode(path)
    height, width = radiance.shape[:2]
    if width != 2 * height:
        raise MalformedFileError(
            path, f"has {width} x {height} pixels, expected 2:1", "use an equirectangular map"
        )
    if not np.isfinite(radiance).all():
        raise NonFiniteError(path, "holds NaN or infinite values", "export it again")
    if not radiance.min() >= 0:
        raise MalformedFileError(path, f"holds negative light ({radiance.min():.3g})", "export it again")
    if not radiance.max() > 0:
        raise MalformedFileError(path, "is black", "choose a map with light")
    return EnvironmentMap(radiance_linear=radiance)


def _decode(path: Path) -> NDArray[np.float32]:
    """Decode an image to linear RGB (H, W, 3)."""
    limit = {"max_pixels": str(MAX_PIXELS)}
    try:
        with av.open(str(path), options=limit) as container:
            decoder = container.streams.video[0].codec_context
            decoder.options = limit
            if decoder.name not in DECODERS:
                raise MalformedFileError(path, f"is not an HDR image, but {decoder.name}", CONVERT)
            picture = next(container.decode(video=0)).to_ndarray()
    except av.error.ArgumentError as error:
        raise LimitExceededError(
            path, f"has more than {MAX_PIXELS} pixels, or names no size", SMALLER
        ) from error
    except (av.error.FFmpegError, StopIteration, IndexError) as error:
        raise MalformedFileError(path, "is not a readable HDR image", CONVERT) from error
    if picture.ndim != 3:
        raise MalformedFileError(path, "has no colors", CONVERT)
    return np.asarray(picture, np.float32)
