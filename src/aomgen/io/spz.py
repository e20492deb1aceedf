"""Gaussians in Niantic's SPZ format, version 3: one gzip stream of quantized attributes.

A file has about a tenth of the size of a 3DGS PLY. A header of 16 bytes is followed by one array for each attribute of
the N Gaussians: positions (24-bit fixed point), opacities (8 bits), colors (8 bits), logarithms of scales (8 bits, in
steps of 1/16), rotations (the three smallest components of xyzw, 10 bits each), and spherical harmonics by coefficient
(8 bits). In the coordinate frame of the format, y points up and z towards the viewer.
"""

import gzip
import io
import zlib
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import xyzw_from_wxyz
from aomgen.core.gaussians import Gaussians, gaussians_of
from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError
from aomgen.io.atomic import write_bytes
from aomgen.io.ply import MAX_GAUSSIANS, check_readable

HEADER: Final = np.dtype(
    [("magic", "<u4"), ("version", "<u4"), ("count", "<u4"),
     ("degree", "u1"), ("fraction", "u1"), ("flags", "u1"), ("reserved", "u1")]
)  # fmt: skip
# "NGSP" as a little-endian integer, and the newest version of the format that is a single gzip stream.
MAGIC, VERSION = 0x5053474E, 3
# A position has 23 bits and a sign. The fraction gets the bits that the integer part of the farthest Gaussian does not
# need, but at most this many, which gives a resolution of 15 micrometers within 128 m.
MOST_FRACTION_BITS: Final = 16
LARGEST: Final = (1 << 23) - 1  # largest signed integer of 24 bits
# A stored color is 0.5 + 0.15 * (coefficient of degree 0), in 0..1. Its range covers colors up to 1.4, where 1 is white.
COLOR_SCALE: Final = 0.15
# A scale s is stored as the byte 16 (log(s) + 10), a coefficient h of a spherical harmonic as 128 + 128 h.
LOG_STEPS, LOG_OFFSET, SH_HALF = 16, 10, 128
# Stored magnitude of a component sqrt(1/2), which the three smallest components of a unit quaternion do not exceed.
ROTATION_MAX: Final = (1 << 9) - 1
_REMEDY = "export the Gaussians again as SPZ version 3"


def read_spz(path: Path, *, max_gaussians: int = MAX_GAUSSIANS) -> Gaussians:
    """Read the Gaussians of an SPZ file, in the coordinates of the file.

    Args:
        path: SPZ file of version 3.
        max_gaussians: Limit of the number of Gaussians, checked before memory is allocated.

    Raises:
        MissingFileError: The file does not exist.
        LimitExceededError: The file holds too many Gaussians.
        MalformedFileError: The file is not an SPZ file, has another version, is truncated or cannot be read.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "check the path")
    try:
        with gzip.open(path) as stream:
            head = stream.read(HEADER.itemsize)
            if len(head) < HEADER.itemsize:
                raise MalformedFileError(path, "ends inside its header", _REMEDY)
            header = np.frombuffer(head, HEADER)[0]
            count, terms = _check_header(path, header, max_gaussians)
            # One byte more than the header announces is requested, so that a longer file is detected.
            data = stream.read(count * (19 + 1 + 3 * terms) + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise MalformedFileError(path, f"cannot be unpacked ({error})", _REMEDY) from error
    if len(data) != count * (20 + 3 * terms):
        raise MalformedFileError(path, f"does not contain the data of {count} Gaussians", _REMEDY)
    rest = io.BytesIO(data)

    def take(columns: int) -> NDArray[np.uint8]:
        return np.frombuffer(rest.read(count * columns), np.uint8).reshape(count, columns)

    positions = take(9).reshape(count, 3, 3).astype(np.int32)
    fixed = positions[..., 0] | positions[..., 1] << 8 | positions[..., 2] << 16
    opacities, colors, scales = take(1)[:, 0], take(3), take(3)
    quats_xyzw = _unpack_rotations(take(4).copy().view("<u4")[:, 0])
    sh = np.empty((count, 1 + terms, 3))
    sh[:, 0] = (colors / 255 - 0.5) / COLOR_SCALE
    sh[:, 1:] = (take(3 * terms).reshape(count, terms, 3) - float(SH_HALF)) / SH_HALF
    return gaussians_of(
        means=(fixed - ((fixed & 0x800000) << 1)) / float(1 << int(header["fraction"])),
        quats=np.roll(quats_xyzw, 1, axis=1),
        scales=np.exp(scales / LOG_STEPS - LOG_OFFSET),
        opacities=opacities / 255,
        sh=sh,
    )


def write_spz(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians to an SPZ file, in their order and coordinates; the format is lossy.

    Positions are rounded to 15 micrometers if all lie within 128 m of the origin, and to 0.12 mm within 1 km. Scales are
    rounded by up to 3 %, rotations by about 0.1 degree, and all other values to 8 bits. Coefficients of spherical harmonics
    above degree 0 are clipped to -1..1, scales to 4.5e-5..380.

    Raises:
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero.
        LimitExceededError: A coordinate exceeds 8 million units.
        StorageError: Writing to the disk failed.
    """
    check_readable(path, gaussians)
    farthest = float(np.abs(gaussians.means).max(initial=1e-9))
    if not farthest <= LARGEST:
        raise LimitExceededError(path, f"would hold a position {farthest:.0f} units away, limit {LARGEST}")
    fraction = min(MOST_FRACTION_BITS, int(np.log2(LARGEST / farthest)))
    fixed = np.rint(gaussians.means.astype(np.float64) * (1 << fraction)).astype(np.int64)
    header = np.array([(MAGIC, VERSION, len(gaussians), gaussians.sh_degree, fraction, 0, 0)], HEADER)
    with np.errstate(divide="ignore"):
        logs = np.log(gaussians.scales.astype(np.float64))
    streams = [
        (fixed[..., None] >> np.array([0, 8, 16]) & 0xFF).astype(np.uint8),
        round_to_bytes(gaussians.opacities * 255),
        round_to_bytes(gaussians.sh[:, 0] * (COLOR_SCALE * 255) + 127.5),
        round_to_bytes((logs + LOG_OFFSET) * LOG_STEPS),
        _pack_rotations(gaussians.quats.astype(np.float64)),
        round_to_bytes(gaussians.sh[:, 1:] * SH_HALF + SH_HALF),
    ]
    content = b"".join([header.tobytes(), *(stream.tobytes() for stream in streams)])
    write_bytes(path, gzip.compress(content, 6, mtime=0))


def _check_header(path: Path, header: np.void, max_gaussians: int) -> tuple[int, int]:
    """Check the header and return the number of Gaussians and the number of coefficients above degree 0."""
    if header["magic"] != MAGIC:
        raise MalformedFileError(path, "does not start as an SPZ file", _REMEDY)
    if header["version"] != VERSION or header["degree"] > 3:
        found = f"version {header['version']} with harmonics of degree {header['degree']}"
        raise MalformedFileError(path, f"has {found}, expected version {VERSION} and degree 0 to 3", _REMEDY)
    count, degree = int(header["count"]), int(header["degree"])
    if not count <= max_gaussians:
        raise LimitExceededError(path, f"holds {count} Gaussians, limit {max_gaussians}")
    return count, (degree + 1) ** 2 - 1


def round_to_bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Round values to 0..255."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _pack_rotations(quats_wxyz: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Pack quaternions (N, 4) into integers (N,).

    From high bits to low, an integer holds the index of the largest component of xyzw, then sign and magnitude of the
    other components.
    """
    quats = xyzw_from_wxyz(quats_wxyz / np.linalg.norm(quats_wxyz, axis=1, keepdims=True))
    largest = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    quats = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    packed = largest.astype(np.uint32)
    for component in range(4):
        values = quats[:, component]
        magnitude = np.rint(ROTATION_MAX * np.minimum(np.abs(values) * np.sqrt(2), 1)).astype(np.uint32)
        longer = packed << np.uint32(10) | (values < 0).astype(np.uint32) << np.uint32(9) | magnitude
        packed = np.where(component == largest, packed, longer)
    return packed.astype("<u4")


def _unpack_rotations(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Unpack integers (N,) of `_pack_rotations` to unit quaternions xyzw (N, 4)."""
    largest = (packed >> np.uint32(30)).astype(np.int64)
    quats = np.zeros((len(packed), 4))
    for component in range(3, -1, -1):
        stored = component != largest
        values = (packed & np.uint32(ROTATION_MAX)) / (ROTATION_MAX * np.sqrt(2))
        signed = np.where(packed & np.uint32(1 << 9), -values, values)
        quats[:, component] = np.where(stored, signed, 0.0)
        packed = np.where(stored, packed >> np.uint32(10), packed)
    rest = np.sqrt(np.maximum(0.0, 1 - (quats**2).sum(1)))
    quats[np.arange(len(quats)), largest] = rest
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
