"""Gaussians in a binary glTF 2.0 file, with the Khronos extension KHR_gaussian_splatting.

The file holds one primitive of points. Its attributes are positions, an 8-bit color for viewers without the extension,
and the float32 attributes of the extension: rotations (xyzw), scales, opacities (0..1), and one attribute for each
spherical harmonic.
"""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import xyzw_from_wxyz
from aomgen.core.gaussians import Gaussians, gaussians_of
from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError
from aomgen.io.atomic import write_bytes
from aomgen.io.ply import MAX_GAUSSIANS, check_readable

EXTENSION: Final = "KHR_gaussian_splatting"
# "glTF", "JSON" and "BIN\0" as little-endian integers, and the version of the format.
MAGIC, JSON_CHUNK, BINARY_CHUNK, VERSION = 0x46546C67, 0x4E4F534A, 0x004E4942, 2
# OpenGL constants of two component types, and of the target of vertex data.
FLOAT, UNSIGNED_BYTE, ARRAY_BUFFER = 5126, 5121, 34962
# Mode of a primitive that consists of points.
POINTS: Final = 0
# Number of components of an accessor's element, by its type.
COMPONENTS: Final = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
# Largest JSON header that is read, [bytes]; that of a file of Gaussians has about 10 kB.
MAX_JSON_BYTES: Final = 1 << 20
_REMEDY = f"export the Gaussians again as .glb with {EXTENSION}"


def read_glb(path: Path, *, max_gaussians: int = MAX_GAUSSIANS) -> Gaussians:
    """Read the Gaussians of a .glb file with a single float32 primitive, in the coordinates of the file.

    Args:
        path: Binary glTF file that contains its data.
        max_gaussians: Limit of the number of Gaussians.

    Raises:
        MissingFileError: The file does not exist.
        LimitExceededError: The file holds too many Gaussians, or its JSON header exceeds `MAX_JSON_BYTES`.
        MalformedFileError: The file is not a .glb, holds no Gaussians or several primitives, transforms a node, or refers
            to data outside of the file; or a scale is negative or an opacity outside of 0..1.
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "check the path")
    described, data = _read_chunks(path)
    try:
        (primitive,) = [item for mesh in described["meshes"] for item in mesh["primitives"]]
        names: Mapping[str, int] = primitive["attributes"]
        extension = EXTENSION in primitive["extensions"]
        moved = any({"matrix", "rotation", "translation", "scale"} & set(node) for node in described["nodes"])
        if not extension or moved:
            raise MalformedFileError(path, "holds no Gaussians, or moves them by a node", _REMEDY)
        count = int(described["accessors"][names["POSITION"]]["count"])
        if not count <= max_gaussians:
            raise LimitExceededError(path, f"holds {count} Gaussians, limit {max_gaussians}")

        def take(name: str) -> NDArray[np.float32]:
            return _read_accessor(described, data, names[name], count)

        found = {kind: take(f"{EXTENSION}:{kind}") for kind in ("ROTATION", "SCALE", "OPACITY")}
        harmonics = [name for name in _harmonic_names(3) if name in names]
        sh = np.stack([take(name) for name in harmonics], 1)
        gaussians = gaussians_of(
            means=take("POSITION"),
            quats=np.roll(found["ROTATION"], 1, axis=1),
            scales=found["SCALE"],
            opacities=found["OPACITY"][:, 0],
            sh=sh,
        )
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise MalformedFileError(path, f"is not a scene of Gaussians ({error!r})", _REMEDY) from error
    if sh.shape[1] not in (1, 4, 9, 16):
        raise MalformedFileError(path, f"has {sh.shape[1]} harmonics, expected 1, 4, 9 or 16", _REMEDY)
    check_readable(path, gaussians)
    if not ((gaussians.scales >= 0).all() and (abs(gaussians.opacities - 0.5) <= 0.5).all()):
        raise MalformedFileError(path, "has a negative scale, or an opacity outside of 0 to 1", _REMEDY)
    return gaussians


def write_glb(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians to a .glb file in their order, as float32 without loss.

    The coordinates are not changed: for glTF, whose y axis points up, the caller rotates them first.

    Raises:
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero.
        StorageError: Writing to the disk failed.
    """
    check_readable(path, gaussians)
    quats = xyzw_from_wxyz(gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True))
    shown = np.column_stack([gaussians.colors_srgb, gaussians.opacities])
    columns: dict[str, NDArray[Any]] = {
        "POSITION": gaussians.means,
        "COLOR_0": np.clip(np.rint(shown * 255), 0, 255).astype(np.uint8),
        f"{EXTENSION}:ROTATION": quats,
        f"{EXTENSION}:SCALE": gaussians.scales,
        f"{EXTENSION}:OPACITY": gaussians.opacities[:, None],
    }
    names = _harmonic_names(gaussians.sh_degree)
    columns |= {name: gaussians.sh[:, number] for number, name in enumerate(names)}
    views, accessors, pieces, offset = [], [], [], 0
    for name, values in columns.items():
        kind = "u1" if values.dtype == np.uint8 else "<f4"
        piece = np.ascontiguousarray(values, kind).tobytes()
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(piece), "target": ARRAY_BUFFER})
        accessor: dict[str, Any] = {
            "bufferView": len(accessors),
            "componentType": UNSIGNED_BYTE if kind == "u1" else FLOAT,
            "count": len(gaussians),
            "type": next(word for word, size in COMPONENTS.items() if size == values.shape[1]),
        }
        if name == "POSITION" and len(gaussians):
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        if kind == "u1":
            accessor["normalized"] = True
        accessors.append(accessor)
        pieces.append(piece)
        offset += len(piece)
    described = {
        "asset": {"version": "2.0", "generator": "AOMGen"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "gaussians"}],
        "meshes": [{"primitives": [{
            "mode": POINTS,
            "attributes": {name: number for number, name in enumerate(columns)},
            "extensions": {EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            }},
        }]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }  # fmt: skip
    text = json.dumps(described, separators=(",", ":")).encode()
    chunks = [_chunk(JSON_CHUNK, text, b" "), _chunk(BINARY_CHUNK, b"".join(pieces), b"\0")]
    length = 12 + sum(len(chunk) for chunk in chunks)
    write_bytes(path, b"".join([struct.pack("<III", MAGIC, VERSION, length), *chunks]))


def _harmonic_names(degree: int) -> list[str]:
    """List the attributes of the spherical harmonics up to a degree, in the order of `Gaussians.sh`."""
    return [
        f"{EXTENSION}:SH_DEGREE_{band}_COEF_{number}"
        for band in range(degree + 1)
        for number in range(2 * band + 1)
    ]


def _chunk(kind: int, data: bytes, filling: bytes) -> bytes:
    """Build a chunk whose data is padded to a multiple of four bytes."""
    data += filling * (-len(data) % 4)
    return struct.pack("<II", len(data), kind) + data


def _read_chunks(path: Path) -> tuple[Any, bytes]:
    """Read the parsed JSON and the binary data of a .glb file."""
    content = path.read_bytes()
    if len(content) < 20 or struct.unpack("<II", content[:8]) != (MAGIC, VERSION):
        raise MalformedFileError(path, "does not start as a .glb of version 2", _REMEDY)
    size, kind = struct.unpack("<II", content[12:20])
    if not size <= MAX_JSON_BYTES:
        raise LimitExceededError(path, f"has a header of {size} bytes, limit {MAX_JSON_BYTES}")
    start = 20 + size
    if kind != JSON_CHUNK or len(content) < start + 8:
        raise MalformedFileError(path, "ends before its data", _REMEDY)
    try:
        described = json.loads(content[20:start])
    except (ValueError, RecursionError) as error:
        raise MalformedFileError(path, f"has a header that is not JSON ({error})", _REMEDY) from error
    length, kind = struct.unpack("<II", content[start : start + 8])
    data = content[start + 8 : start + 8 + length]
    if kind != BINARY_CHUNK or len(data) != length:
        raise MalformedFileError(path, "ends inside its data", _REMEDY)
    return described, data


def _read_accessor(described: Any, data: bytes, number: int, count: int) -> NDArray[np.float32]:
    """Return the rows (count, C) of a float32 attribute; raise ValueError if they are not inside the data."""
    accessor = described["accessors"][number]
    view = described["bufferViews"][accessor["bufferView"]]
    columns = COMPONENTS[accessor["type"]]
    start = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
    size = 4 * columns * count
    if accessor["componentType"] != FLOAT or accessor["count"] != count or "byteStride" in view:
        raise ValueError("an attribute is not packed float32")
    if start < 0 or start + size > len(data):
        raise ValueError("an attribute lies outside of the data")
    return np.frombuffer(data, "<f4", columns * count, start).reshape(count, columns)
