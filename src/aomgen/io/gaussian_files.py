"""Gaussians in any known file format, chosen by the suffix, and the format of `.splat` files.

These hold 32 bytes a Gaussian, one color, no header: float32 position[3], float32 scale[3] (not logarithms),
uint8 color[3] (sRGB) and opacity, uint8 rotation[4] (wxyz, (byte - 128) / 128). Little-endian. They have no
spherical harmonics, no frame and no unit.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

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
    """Read the Gaussians of a `.splat`, of SH degree 0; quaternions are normalised.

    Args:
        path: File without header; its length says how many Gaussians it holds.
        max_gaussians: Larger files are refused before anything is allocated.

    Raises:
        MissingFileError: No such file, or it cannot be opened.
        LimitExceededError: Too many Gaussians.
        MalformedFileError: The length is no multiple of 32 bytes, or a scale is negative.
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
    """Write Gaussians in their order as a `.splat`; lossy.

    Colors, opacities and rotations are rounded to 8 bits (up to 1/510, 1/510 and about one
    degree), colors are cut to 0..1, and spherical harmonics above degree 0 are dropped.

    Raises:
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero.
        StorageError: Writing to the disk failed.
    """
    check_readable(path, gaussians)
    table = np.empty(len(gaussians), RECORD)
    norms = np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    table["means"], table["scales"] = gaussians.means, gaussians.scales
    table["color"] = _bytes((0.5 + SH_C0 * gaussians.sh[:, 0]) * 255)
    table["opacity"] = _bytes(gaussians.opacities * 255)
    table["quats"] = _bytes(gaussians.quats / norms * 128 + 128)
    write_bytes(path, table.tobytes())


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


F = TypeVar("F")
_READERS = {".ply": ply.read_gaussians, ".splat": read_splat, ".spz": spz.read_spz, ".glb": gltf.read_glb}
_WRITERS = {".ply": ply.write_gaussians, ".splat": write_splat, ".spz": spz.write_spz, ".glb": gltf.write_glb}
# Formats whose coordinates are y up; readers and writers here leave them as they are.
Y_UP_SUFFIXES = (".spz", ".glb")
# Suffixes that `write_gaussians` accepts.
WRITTEN_SUFFIXES = (*_WRITERS, *usd.SUFFIXES)


def read_gaussians(path: Path, *, max_gaussians: int = MAX_GAUSSIANS) -> Gaussians:
    """Read a 3DGS `.ply`, a `.splat`, a `.spz`, or a `.glb` of KHR_gaussian_splatting.

    Raises:
        ConfigError: Another suffix.
        MissingFileError, LimitExceededError, MalformedFileError, NonFiniteError: See
            `ply.read_gaussians`, `read_splat`, `spz.read_spz` and `gltf.read_glb`.
    """
    return _choose(path, _READERS, "read")(path, max_gaussians=max_gaussians)


def write_gaussians(path: Path, gaussians: Gaussians, *, meters_per_unit: float = 1.0) -> None:
    """Write a 3DGS `.ply`, `.glb`, `.usda` or `.usdc` (exact, USD z up), a `.spz` (8 bits) or a `.splat` (8 bits, one color).

    Args:
        path: Its suffix chooses the format.
        gaussians: In any frame.
        meters_per_unit: Length of their unit, which USD files state, [m].

    Raises:
        ConfigError: Another suffix.
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero.
        LimitExceededError: A position does not fit into a `.spz`.
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
