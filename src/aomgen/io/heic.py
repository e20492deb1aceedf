"""Reader of HEIC images, which phones write, with the optional dependency pi-heif."""

import importlib.util
from pathlib import Path
from typing import Final

from PIL import Image

from aomgen.errors import BackendError, LimitExceededError, MalformedFileError, MissingFileError
from aomgen.io.images import MAX_PIXELS

HEIC_SUFFIXES: Final = (".heic", ".heif")


def open_heic(path: Path) -> Image.Image:
    """Decode the main image of a HEIC file; it is upright, and its `info["exif"]` holds the EXIF data.

    Raises:
        BackendError: pi-heif is not installed.
        MissingFileError, MalformedFileError, LimitExceededError: The file is missing, malformed or too large.
    """
    if importlib.util.find_spec("pi_heif") is None:
        raise BackendError(
            "pi-heif", f"is not installed, and {path.name} is HEIC", "pip install 'aomgen[heic]'"
        )
    import pi_heif

    if not path.is_file():
        raise MissingFileError(path, "is missing", "check the folder")
    try:
        found = pi_heif.open_heif(path)
        width, height = found.size
        if not width * height <= MAX_PIXELS:
            raise LimitExceededError(path, f"has {width} x {height} pixels, limit {MAX_PIXELS}")
        return found.to_pillow()
    except (ValueError, OSError, EOFError, SyntaxError, RuntimeError, IndexError) as error:
        reason = " ".join(str(error).split())
        raise MalformedFileError(path, f"cannot be decoded ({reason})", "copy or export it again") from error
