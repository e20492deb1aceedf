"""Gaussians in the PLY layout of the 3DGS reference implementation: bounded, with typed errors.

The files hold logarithms of scales, logits of opacities, and SH coefficients by channel:
x y z nx ny nz, f_dc_0..2, f_rest_0.., opacity, scale_0..2, rot_0..3 (wxyz).
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.core.gaussians import Gaussians
from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError, NonFiniteError
from aomgen.io.atomic import write_bytes

MAX_GAUSSIANS = 10_000_000
MAX_HEADER_BYTES = 64 << 10
MAX_PROPERTIES = 256
_END = re.compile(rb"\nend_header *\r?\n")
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
    """Read Gaussians of SH degree 0..3; quaternions are normalised, unknown properties ignored.

    Args:
        path: Binary PLY of either byte order, with one element called `vertex`.
        max_gaussians: Larger files are refused before anything is allocated.

    Raises:
        MissingFileError: No such file, or it cannot be opened.
        LimitExceededError: Too many Gaussians, or a header beyond all reason.
        MalformedFileError: Not a PLY of this layout, truncated, or with bytes left over.
        NonFiniteError: A value is NaN, infinite or beyond float32, or a quaternion is zero.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "check the path")
    try:
        with path.open("rb") as file:
            head = file.read(MAX_HEADER_BYTES)
    except OSError as error:
        raise MissingFileError(path, f"cannot be read ({error.strerror})", "check its permissions") from error
    lines, start = _header_lines(path, head)
    order, count, properties = _parse_header(path, lines)
    if not count <= max_gaussians:
        raise LimitExceededError(path, f"holds {count} Gaussians, limit {max_gaussians}")
    dtype = np.dtype([(name, order + kind) for name, kind in properties])
    want, have = start + count * dtype.itemsize, path.stat().st_size
    if have != want:
        raise MalformedFileError(path, f"has {have} bytes, its header needs {want}", _REMEDY)
    table = np.fromfile(path, dtype, count, offset=start)
    if len(table) != count:
        raise MalformedFileError(path, "became shorter while it was read", "wait until it is written")
    return _gaussians(path, table)


def write_gaussians(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians in the reference layout, little-endian float32.

    Opacities of exactly 0 or 1 and scales of 0 have no finite logit or logarithm; they are
    moved by 1e-7 (1e-12 m).

    Raises:
        StorageError: The disk refuses.
    """
    sh = gaussians.sh
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(gaussians), 3 * (sh.shape[1] - 1))
    opacities = np.clip(gaussians.opacities.astype(np.float64), 1e-7, 1 - 1e-7)
    columns = [
        gaussians.means,
        np.zeros_like(gaussians.means),
        sh[:, 0],
        rest,
        np.log(opacities / (1 - opacities))[:, None],
        np.log(np.maximum(gaussians.scales.astype(np.float64), 1e-12)),
        gaussians.quats,
    ]
    names = _names(rest.shape[1])
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(gaussians)}"]
    header += [f"property float {name}" for name in names] + ["end_header"]
    table = np.concatenate(columns, axis=1).astype("<f4")
    write_bytes(path, ("\n".join(header) + "\n").encode() + table.tobytes())


def _names(rest: int) -> list[str]:
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(rest)] + ["opacity"]
    return names + [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]


def _header_lines(path: Path, head: bytes) -> tuple[list[str], int]:
    """Lines of the header and where the data starts."""
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


def _parse_header(path: Path, lines: list[str]) -> tuple[str, int, list[tuple[str, str]]]:
    """Byte order, number of Gaussians and (name, type) of their properties."""
    order, count = "", -1
    properties: list[tuple[str, str]] = []
    for line in lines:
        match line.split():
            case ["comment" | "obj_info", *_] | []:
                continue
            case ["format", name, "1.0"] if name in _ORDERS and not order:
                order = _ORDERS[name]
            case ["format", name, *_] if not order:
                raise MalformedFileError(path, f"has format {name}, want {' or '.join(_ORDERS)}", _REMEDY)
            case ["element", "vertex", digits] if count < 0 and digits.isdecimal() and len(digits) < 16:
                count = int(digits)
            case ["property", kind, name] if count >= 0 and kind in _TYPES:
                properties.append((name, _TYPES[kind]))
            case _:
                raise MalformedFileError(
                    path, f"has the header line {line[:80]!r}, which is not understood", _REMEDY
                )
    if not order or count < 0:
        raise MalformedFileError(path, "names no format or no vertices", _REMEDY)
    if not len(properties) <= MAX_PROPERTIES:
        raise LimitExceededError(path, f"has {len(properties)} properties, limit {MAX_PROPERTIES}")
    names = [name for name, _ in properties]
    if len(set(names)) != len(names):
        raise MalformedFileError(path, "names a property twice", _REMEDY)
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in _REST_COUNTS:
        raise MalformedFileError(path, f"has {rest} f_rest properties, want {sorted(_REST_COUNTS)}", _REMEDY)
    missing = [name for name in _names(rest) if name not in names and name not in ("nx", "ny", "nz")]
    if missing:
        raise MalformedFileError(path, f"misses the properties {', '.join(missing)}", _REMEDY)
    return order, count, properties


def _gaussians(path: Path, table: NDArray) -> Gaussians:
    rest = sum(name.startswith("f_rest_") for name in table.dtype.names or ())

    def columns(*names: str) -> NDArray[np.float64]:
        with np.errstate(invalid="ignore"):  # signalling NaNs, refused below
            values = np.stack([table[name].astype(np.float64) for name in names], 1)
        broken = ~(np.abs(values) <= _LARGEST)
        if broken.any():
            row, column = np.argwhere(broken)[0]
            raise NonFiniteError(path, f"Gaussian {row} has {names[column]} = {values[row, column]}", _REMEDY)
        return values

    quats = columns("rot_0", "rot_1", "rot_2", "rot_3")
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    if not (norms > 1e-12).all():
        raise NonFiniteError(path, f"Gaussian {int(norms.argmin())} has a rotation of length zero", _REMEDY)
    by_channel = columns(*[f"f_rest_{i}" for i in range(rest)]) if rest else np.zeros((len(table), 0))
    sh = np.concatenate(
        [
            columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None],
            by_channel.reshape(len(table), 3, rest // 3).swapaxes(1, 2),
        ],
        axis=1,
    )
    logits, log_scales = columns("opacity")[:, 0], columns("scale_0", "scale_1", "scale_2")
    if not (np.abs(log_scales) <= 80).all():
        raise NonFiniteError(path, "a scale is beyond the range of numbers", _REMEDY)
    return Gaussians(
        means=_single(columns("x", "y", "z")),
        quats=_single(quats / norms),
        scales=_single(np.exp(log_scales)),
        opacities=_single(1 / (1 + np.exp(-np.clip(logits, -80, 80)))),
        sh=_single(sh),
    )


def _single(values: NDArray[np.float64]) -> NDArray[np.float32]:
    return values.astype(np.float32)
