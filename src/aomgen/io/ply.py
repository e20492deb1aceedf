"""Gaussians in the PLY layout of the 3DGS reference implementation, with limits on size and typed errors.

The files hold logarithms of scales, logits of opacities, and coefficients of spherical harmonics (SH) by channel:
x y z nx ny nz, f_dc_0..2, f_rest_0.., opacity, scale_0..2, rot_0..3 (wxyz).
"""

import re
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.gaussians import Gaussians
from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError, NonFiniteError
from aomgen.io.atomic import write_bytes

# Largest number of Gaussians that is read; at SH degree 3 one takes about 250 bytes of memory.
MAX_GAUSSIANS: Final = 10_000_000
# Largest header that is read, [bytes]; with all properties of SH degree 3 it has 2 kB.
MAX_HEADER_BYTES: Final = 64 << 10
# Largest number of properties in a file; Gaussians of SH degree 3 have 62, and unknown properties are skipped.
MAX_PROPERTIES: Final = 256
# Number of Gaussians that are converted at a time, so that the temporary arrays fit into the processor's cache.
BLOCK: Final = 1 << 13
_END = re.compile(rb"\nend_header *\r?\n")
# Degree of the spherical harmonics by the number of f_rest properties.
_REST_COUNTS = {0: 0, 9: 1, 24: 2, 45: 3}
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_LARGEST = float(np.finfo(np.float32).max)
_REMEDY = "export the Gaussians again as binary 3DGS PLY"


def read_gaussians(path: Path, *, max_gaussians: int = MAX_GAUSSIANS) -> Gaussians:
    """Read Gaussians of SH degree 0..3; quaternions are normalized.

    Properties may have any order and numeric type. Unknown properties, and elements other than `vertex`, are skipped.

    Args:
        path: Binary PLY of either byte order, without list properties.
        max_gaussians: Limit of the number of Gaussians, checked before memory is allocated.

    Raises:
        MissingFileError: The file does not exist or cannot be opened.
        LimitExceededError: The file holds too many Gaussians or properties, or its header exceeds `MAX_HEADER_BYTES`.
        MalformedFileError: The file is not a binary PLY of this layout, is truncated, or has bytes after its data.
        NonFiniteError: A value is NaN, infinite or outside the range of float32, or a quaternion is zero.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "check the path")
    try:
        with path.open("rb") as file:
            head = file.read(MAX_HEADER_BYTES)
    except OSError as error:
        raise MissingFileError(path, f"cannot be read ({error.strerror})", "check its permissions") from error
    lines, start = _header_lines(path, head)
    elements = _parse_header(path, lines)
    index = [name for name, _, _ in elements].index("vertex")
    _, count, dtype = elements[index]
    rest = _check_names(path, list(dtype.names or ()))
    if not count <= max_gaussians:
        raise LimitExceededError(path, f"holds {count} Gaussians, limit {max_gaussians}")
    sizes = [rows * kind.itemsize for _, rows, kind in elements]
    want, have = start + sum(sizes), path.stat().st_size
    if have != want:
        raise MalformedFileError(path, f"has {have} bytes, its header needs {want}", _REMEDY)
    return _read_vertices(path, dtype, (start + sum(sizes[:index]), count), rest)


def write_gaussians(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians in the layout of the reference implementation, as little-endian float32.

    Opacities of 0 or 1 have no finite logit and scales of 0 no finite logarithm; opacities are therefore clipped to
    1e-7..1 - 1e-7, and scales to at least 1e-12.

    Raises:
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero.
        StorageError: Writing to the disk failed.
    """
    check_readable(path, gaussians)
    rest = 3 * (gaussians.sh.shape[1] - 1)
    names = _names(rest)
    opacities = np.clip(gaussians.opacities.astype(np.float64), 1e-7, 1 - 1e-7)
    table = np.zeros((len(gaussians), len(names)), "<f4")
    table[:, 0:3] = gaussians.means
    table[:, 6:9] = gaussians.sh[:, 0]
    table[:, 9 : 9 + rest] = gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(len(gaussians), rest)
    table[:, -8] = np.log(opacities / (1 - opacities))
    table[:, -7:-4] = np.log(np.maximum(gaussians.scales.astype(np.float64), 1e-12))
    table[:, -4:] = gaussians.quats
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(gaussians)}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    write_bytes(path, b"".join(["\n".join(header).encode(), table.tobytes()]))


def check_readable(path: Path, gaussians: Gaussians) -> None:
    """Check that Gaussians are finite and have valid quaternions, which readers of all formats require.

    Args:
        path: File to be written, for messages.
        gaussians: Gaussians to check.

    Raises:
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero; the message gives the index of the first
            such Gaussian.
    """
    good = np.abs(gaussians.quats).max(1, initial=0) > 1e-12
    for name in ("means", "quats", "scales", "opacities", "sh"):
        values = getattr(gaussians, name)
        good &= np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    if not good.all():
        problem = f"Gaussian {int(good.argmin())} is not finite or has a rotation of length zero"
        raise NonFiniteError(path, problem, "leave it out")


def _names(rest: int) -> list[str]:
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(rest)] + ["opacity"]
    return names + [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]


def _header_lines(path: Path, head: bytes) -> tuple[list[str], int]:
    """Return the lines of the header after the first, and the offset of the data, [bytes]."""
    if not head.startswith((b"ply\n", b"ply\r\n")):
        raise MalformedFileError(path, "does not start as a PLY file", _REMEDY)
    end = _END.search(head)
    if not end:
        if len(head) >= MAX_HEADER_BYTES:
            raise LimitExceededError(path, f"has a header of more than {MAX_HEADER_BYTES} bytes")
        raise MalformedFileError(path, "ends inside its header", _REMEDY)
    try:
        return head[: end.start()].decode("ascii").split("\n")[1:], end.end()
    except UnicodeDecodeError as error:
        raise MalformedFileError(path, "has a header that is not ASCII", _REMEDY) from error


def _parse_header(path: Path, lines: list[str]) -> list[tuple[str, int, np.dtype[np.void]]]:
    """Parse name, number of rows and type of a row of each element; exactly one element is called `vertex`."""
    order, element = "", ""
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    columns: list[tuple[str, str]] = []
    for line in lines:
        match line.split():
            case ["comment" | "obj_info", *_] | []:
                continue
            case ["format", name, "1.0"] if name in _ORDERS and not order:
                order = _ORDERS[name]
            case ["format", name, *_] if not order:
                raise MalformedFileError(path, f"has format {name}, expected {' or '.join(_ORDERS)}", _REMEDY)
            case ["element", element, digits] if digits.isdecimal() and len(digits) < 16:
                columns = []
                elements.append((element, int(digits), columns))
            case ["property", kind, name] if elements and kind in _TYPES:
                columns.append((name, _TYPES[kind]))
            case ["property", "list", *_] if elements:
                raise MalformedFileError(path, f"has a list in element {element}", _REMEDY)
            case _:
                raise MalformedFileError(
                    path, f"has the header line {line[:80]!r}, which is not understood", _REMEDY
                )
    if not order or [name for name, _, _ in elements].count("vertex") != 1:
        raise MalformedFileError(path, "names no format, or not one element called vertex", _REMEDY)
    total = sum(len(columns) for _, _, columns in elements)
    if not total <= MAX_PROPERTIES:
        raise LimitExceededError(path, f"has {total} properties, limit {MAX_PROPERTIES}")
    if any(len(dict(columns)) != len(columns) for _, _, columns in elements):
        raise MalformedFileError(path, "names a property twice", _REMEDY)
    return [
        (name, rows, np.dtype([(column, order + kind) for column, kind in columns]))
        for name, rows, columns in elements
    ]


def _check_names(path: Path, names: list[str]) -> int:
    """Check that all properties of the layout are present, and return the number of f_rest properties."""
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in _REST_COUNTS:
        raise MalformedFileError(
            path, f"has {rest} f_rest properties, expected {sorted(_REST_COUNTS)}", _REMEDY
        )
    missing = [name for name in _names(rest) if name not in names and name not in ("nx", "ny", "nz")]
    if missing:
        raise MalformedFileError(path, f"misses the properties {', '.join(missing)}", _REMEDY)
    return rest


def _read_vertices(path: Path, dtype: np.dtype[np.void], where: tuple[int, int], rest: int) -> Gaussians:
    """Read Gaussians from the table at `where`, (offset in bytes, number of rows), in blocks."""
    offset, count = where
    coefficients = 1 + rest // 3
    means, quats = np.empty((count, 3), np.float32), np.empty((count, 4), np.float32)
    scales, opacities = np.empty((count, 3), np.float32), np.empty(count, np.float32)
    sh = np.empty((count, coefficients, 3), np.float32)
    names = [name for name in _names(rest) if name not in ("nx", "ny", "nz")]
    with path.open("rb") as file:
        file.seek(offset)
        for first in range(0, count, BLOCK):
            rows = slice(first, min(first + BLOCK, count))
            table = np.fromfile(file, dtype, rows.stop - first)
            if len(table) != rows.stop - first:
                raise MalformedFileError(path, "became shorter while it was read", "wait until it is written")
            with np.errstate(invalid="ignore"):  # signaling NaNs are refused below
                values = np.stack([table[name].astype(np.float64) for name in names], 1)
            _check_values(path, names, values, first)
            means[rows] = values[:, :3]
            quats[rows] = values[:, -4:] / np.linalg.norm(values[:, -4:], axis=1, keepdims=True)
            scales[rows] = np.exp(values[:, -7:-4])
            opacities[rows] = 1 / (1 + np.exp(-np.clip(values[:, -8], -80, 80)))
            sh[rows, 0] = values[:, 3:6]
            by_channel = values[:, 6 : 6 + rest].reshape(len(values), 3, coefficients - 1)
            sh[rows, 1:] = by_channel.swapaxes(1, 2)
    return Gaussians(means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)


def _check_values(path: Path, names: list[str], values: NDArray[np.float64], first: int) -> None:
    """Check that rows hold finite float32 values and valid quaternions; `first` is the index of the Gaussian in row 0."""
    good = np.abs(values) <= _LARGEST
    if not good.all():
        row, column = np.argwhere(~good)[0]
        problem = f"Gaussian {first + row} has {names[column]} = {values[row, column]}"
        raise NonFiniteError(path, problem, _REMEDY)
    norms = np.linalg.norm(values[:, -4:], axis=1)
    if not (norms > 1e-12).all():
        problem = f"Gaussian {first + int(norms.argmin())} has a rotation of length zero"
        raise NonFiniteError(path, problem, _REMEDY)
    sizes = np.abs(values[:, -7:-4]).max(1)
    if not (sizes <= 80).all():
        problem = f"Gaussian {first + int(sizes.argmax())} has a scale beyond the range of numbers"
        raise NonFiniteError(path, problem, _REMEDY)
