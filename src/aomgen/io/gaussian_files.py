"""Reading and writing of Gaussians in all supported formats, selected by the suffix, and the `.splat` format.

A `.splat` file has no header and 32 bytes per Gaussian, little-endian: float32 position[3], float32 scale[3] (not
logarithms), uint8 color[3] (sRGB), uint8 opacity, uint8 rotation[4] (wxyz, (byte - 128) / 128). It contains no spherical
harmonics above degree 0 and specifies neither frame nor unit.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np

from aomgen.core.gaussians import SH_C0, Gaussians, gaussians_of
from aomgen.errors import (
    ConfigError,
    LimitExceededError,
    MalformedFileError,
    MissingFileError,
    NonFiniteError,
)
from aomgen.io import gltf, ply, spz, usd
from aomgen.io.atomic import write_bytes
from aomgen.io.ply import MAX_GAUSSIANS, check_readable

RECORD = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("color", "u1", 3), ("opacity", "u1"), ("quats", "u1", 4)]
)
_REMEDY = "export the Gaussians again"


def read_splat(path: Path, *, max_gaussians: int = MAX_GAUSSIANS) -> Gaussians:
    """Read the Gaussians of a `.splat` file, of SH degree 0; quaternions are normalized.

    Args:
        path: `.splat` file; the number of Gaussians follows from its length.
        max_gaussians: Limit of the number of Gaussians, checked before memory is allocated.

    Raises:
        MissingFileError: The file does not exist or cannot be opened.
        LimitExceededError: The file holds too many Gaussians.
        MalformedFileError: The length is not a multiple of 32 bytes, or a scale is negative.
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "check the path")
    size = path.stat().st_size
    count, rest = divmod(size, RECORD.itemsize)
    if rest:
        raise MalformedFileError(path, f"has {size} bytes, no multiple of {RECORD.itemsize}", _REMEDY)
    if not count <= max_gaussians:
        raise LimitExceededError(path, f"holds {count} Gaussians, limit {max_gaussians}")
    try:
        table = np.fromfile(path, RECORD, count)
    except OSError as error:
        raise MissingFileError(path, f"cannot be read ({error.strerror})", "check its permissions") from error
    if len(table) != count:
        raise MalformedFileError(path, "became shorter while it was read", "wait until it is written")
    for name in ("means", "scales"):
        if not np.isfinite(table[name]).all():
            row = int(np.argwhere(~np.isfinite(table[name]))[0, 0])
            raise NonFiniteError(path, f"Gaussian {row} has {name} {table[name][row]}", _REMEDY)
    if not (table["scales"] >= 0).all():
        row = int(table["scales"].min(1).argmin())
        raise MalformedFileError(
            path, f"Gaussian {row} has the negative scales {table['scales'][row]}", _REMEDY
        )
    quats = (table["quats"].astype(np.float64) - 128) / 128
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    if not (norms > 0).all():
        raise NonFiniteError(path, f"Gaussian {int(norms.argmin())} has a rotation of length zero", _REMEDY)
    return gaussians_of(
        means=table["means"],
        quats=quats / norms,
        scales=table["scales"],
        opacities=table["opacity"] / 255.0,
        sh=(table["color"][:, None] / 255.0 - 0.5) / SH_C0,
    )


def write_splat(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians to a `.splat` file in their order; the format is lossy.

    Colors, opacities and rotations are rounded to 8 bits, with errors of up to 1/510, 1/510 and about one degree. Colors
    are clipped to 0..1, and spherical harmonics above degree 0 are omitted.

    Raises:
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero.
        StorageError: Writing to the disk failed.
    """
    check_readable(path, gaussians)
    table = np.empty(len(gaussians), RECORD)
    norms = np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    table["means"], table["scales"] = gaussians.means, gaussians.scales
    table["color"] = spz.round_to_bytes((0.5 + SH_C0 * gaussians.sh[:, 0]) * 255)
    table["opacity"] = spz.round_to_bytes(gaussians.opacities * 255)
    table["quats"] = spz.round_to_bytes(gaussians.quats / norms * 128 + 128)
    write_bytes(path, table.tobytes())


F = TypeVar("F")
_READERS = {".ply": ply.read_gaussians, ".splat": read_splat, ".spz": spz.read_spz, ".glb": gltf.read_glb}
_WRITERS = {".ply": ply.write_gaussians, ".splat": write_splat, ".spz": spz.write_spz, ".glb": gltf.write_glb}
# Formats with y up; the functions of this module do not change coordinates.
Y_UP_SUFFIXES = (".spz", ".glb")
# Suffixes that `write_gaussians` accepts.
WRITTEN_SUFFIXES = (*_WRITERS, *usd.SUFFIXES)


def read_gaussians(path: Path, *, max_gaussians: int = MAX_GAUSSIANS) -> Gaussians:
    """Read Gaussians from a 3DGS `.ply`, a `.splat`, a `.spz`, or a `.glb` file with KHR_gaussian_splatting.

    Args:
        path: File; its suffix selects the format.
        max_gaussians: Limit of the number of Gaussians.

    Returns:
        Gaussians in the coordinates of the file.

    Raises:
        ConfigError: The suffix is a different one.
        MissingFileError, LimitExceededError, MalformedFileError, NonFiniteError: See
            `ply.read_gaussians`, `read_splat`, `spz.read_spz` and `gltf.read_glb`.
    """
    return _choose(path, _READERS, "read")(path, max_gaussians=max_gaussians)


def write_gaussians(path: Path, gaussians: Gaussians, *, meters_per_unit: float = 1.0) -> None:
    """Write Gaussians to a file whose suffix selects the format, without a change of coordinates.

    A 3DGS `.ply`, a `.glb` and USD files (`.usda`, `.usdc`, `.usdz`) hold float32 values, a `.spz` quantized values, and a
    `.splat` 8-bit values without spherical harmonics above degree 0.

    Args:
        path: File to write.
        gaussians: Gaussians in the frame of the file; y is up in `.spz` and `.glb`, z in USD files.
        meters_per_unit: Length of the unit of the coordinates, [m], which USD files state.

    Raises:
        ConfigError: The suffix is a different one.
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero.
        LimitExceededError: A position is outside the range of a `.spz`.
        StorageError: Writing to the disk failed.
    """
    if path.suffix.lower() in usd.SUFFIXES:
        usd.write_gaussians(path, gaussians, meters_per_unit=meters_per_unit)
    else:
        _choose(path, _WRITERS, "written")(path, gaussians)


def _choose(path: Path, known: Mapping[str, F], what: str) -> F:
    if path.suffix.lower() not in known:
        raise ConfigError(
            path, f"has suffix {path.suffix!r}, {', '.join(known)} can be {what}", "rename or convert it"
        )
    return known[path.suffix.lower()]
