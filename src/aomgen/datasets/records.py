"""Readers and writers of TFRecord files of `tf.train.Example` (without TensorFlow), and of ArrayRecord files.

A TFRecord consists of its length (8 bytes, little-endian), the masked CRC of the length (4), its data, and their masked
CRC (4). An Example is a protocol buffer that maps names to lists of bytes, floats or integers. ArrayRecord files, which
Grain reads in any order, are written by Google's library.

Source: TensorFlow's guide "TFRecord and tf.train.Example"; protocol buffers' guide "Encoding".
"""

import struct
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from aomgen.errors import BackendError, MalformedFileError, MissingFileError

# TensorFlow rotates a CRC by 15 bits and adds this constant, because CRCs of data that contain CRCs are unreliable.
MASK_TURN, MASK_ADDED = 15, 0xA282EAD8
# Largest unsigned integers of 32 and 64 bits.
MAX_32, MAX_64 = 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF
# Wire type of protocol buffers (the low three bits of a tag) for fields with a length prefix.
DELIMITED = 2
# Field numbers of the three kinds of lists in a Feature.
BYTES_LIST, FLOAT_LIST, INT64_LIST = 1, 2, 3
REMEDY: Final = "export it again"
# Option of ArrayRecord with which every record can be read separately.
OPTIONS: Final = "group_size:1"
Feature = list[bytes] | NDArray[Any]


def mask_crc(data: bytes) -> int:
    """Compute the masked CRC-32C that TFRecord stores."""
    crc = google_crc32c.value(data)
    return ((crc >> MASK_TURN | crc << (32 - MASK_TURN)) + MASK_ADDED) & MAX_32


def records_bytes(records: Iterable[bytes]) -> bytes:
    """Encode records as the content of a TFRecord file."""
    parts = []
    for record in records:
        length = struct.pack("<Q", len(record))
        parts += [
            length,
            struct.pack("<I", mask_crc(length)),
            record,
            struct.pack("<I", mask_crc(record)),
        ]
    return b"".join(parts)


def read_records(path: Path) -> Iterator[bytes]:
    """Yield the records of a TFRecord file, whose CRCs are checked.

    Raises:
        MissingFileError: The file does not exist.
                MalformedFileError: The file ends inside a record, or data do not match their CRC.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", REMEDY)
    left = path.stat().st_size
    with path.open("rb") as file:
        number = 0
        while left:
            head = file.read(12)
            length = _check(path, number, head[:8], head[8:])
            (size,) = struct.unpack("<Q", length)
            # Checked before this amount of memory is allocated.
            if not size + 16 <= left:
                raise MalformedFileError(path, f"ends inside record {number}", REMEDY)
            yield _check(path, number, file.read(size), file.read(4))
            left -= size + 16
            number += 1


def _check(path: Path, number: int, data: bytes, crc: bytes) -> bytes:
    if len(crc) < 4:
        raise MalformedFileError(path, f"ends inside record {number}", REMEDY)
    if struct.unpack("<I", crc) != (mask_crc(data),):
        raise MalformedFileError(path, f"record {number} does not match its CRC", REMEDY)
    return data


def encode_example(features: Mapping[str, Feature]) -> bytes:
    """Serialize a `tf.train.Example`.

    Args:
        features: Bytes, or numbers of any shape: floats are stored in single precision, others (and bool)
            as whole numbers.
    """
    entries = (
        _delimit(1, name.encode()) + _delimit(2, _encode_feature(value)) for name, value in features.items()
    )
    return _delimit(1, b"".join(_delimit(1, entry) for entry in entries))


def _encode_feature(value: Feature) -> bytes:
    if isinstance(value, list):
        return _delimit(BYTES_LIST, b"".join(_delimit(1, item) for item in value))
    if value.dtype.kind == "f":
        return _delimit(FLOAT_LIST, _delimit(1, value.astype("<f4").tobytes()))
    numbers = b"".join(_varint(int(number) & MAX_64) for number in value.ravel())
    return _delimit(INT64_LIST, _delimit(1, numbers))


def _varint(number: int) -> bytes:
    """Encode an integer with seven bits per byte, lowest first; the eighth bit marks continuation."""
    result = bytearray()
    while number > 127:
        result.append(number & 127 | 128)
        number >>= 7
    result.append(number)
    return bytes(result)


def _delimit(field: int, data: bytes) -> bytes:
    return _varint(field << 3 | DELIMITED) + _varint(len(data)) + data


def decode_example(record: bytes, where: Path) -> dict[str, Feature]:
    """Decode the features of a serialized Example; numbers are flat arrays of float32 or int64.

    Raises:
        MalformedFileError: The data are not an Example; `where` names their source.
    """
    try:
        features: dict[str, Feature] = {}
        for _, content in _parts(memoryview(record)):
            for _, entry in _parts(content):
                (_, name), (_, value) = _parts(entry)
                features[str(name, "utf-8")] = _decode_feature(value)
    except ValueError as error:
        raise MalformedFileError(
            where, f"contains a record that is not an Example ({error})", REMEDY
        ) from error
    return features


def _decode_feature(value: memoryview) -> Feature:
    ((kind, items),) = _parts(value)
    if kind == BYTES_LIST:
        return [bytes(item) for _, item in _parts(items)]
    packed = b"".join(bytes(item) for _, item in _parts(items))
    if kind == FLOAT_LIST:
        return np.frombuffer(packed, "<f4")
    return np.array(list(_numbers(memoryview(packed))), np.uint64).astype(np.int64)


def _parts(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield number and content of each field of a message; all fields of an Example have a length prefix."""
    place = 0
    while place < len(data):
        tag, place = _read_varint(data, place)
        size, place = _read_varint(data, place)
        if tag & 7 != DELIMITED or not place + size <= len(data):
            raise ValueError("a field has another type or is cut")
        yield tag >> 3, data[place : place + size]
        place += size


def _numbers(data: memoryview) -> Iterator[int]:
    place = 0
    while place < len(data):
        number, place = _read_varint(data, place)
        yield number


def _read_varint(data: memoryview, place: int) -> tuple[int, int]:
    """Read an integer; returns it and the position after it."""
    number = 0
    for shift in range(0, 64, 7):
        if not place < len(data):
            break
        byte = data[place]
        number |= (byte & 127) << shift
        place += 1
        if byte < 128:
            return number & MAX_64, place
    raise ValueError("a number is cut")


def require_array_record() -> Any:
    """Import the library of ArrayRecord.

    Raises:
        BackendError: The library is not installed.
    """
    try:
        from array_record.python import array_record_module
    except ImportError as error:
        raise BackendError(
            "array_record", "is not installed", "pip install 'aomgen[array-record]'"
        ) from error
    return array_record_module


def write_array_record(path: Path, records: Iterable[bytes]) -> None:
    """Write an ArrayRecord file into an existing folder."""
    writer = require_array_record().ArrayRecordWriter(str(path), OPTIONS)
    for record in records:
        writer.write(record)
    writer.close()


def read_array_record(path: Path) -> list[bytes]:
    """Read the records of an ArrayRecord file.

    Raises:
        MissingFileError: The file does not exist.
                MalformedFileError: The file is truncated or damaged.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", REMEDY)
    try:
        return require_array_record().ArrayRecordReader(str(path)).read_all()
    except RuntimeError as error:
        raise MalformedFileError(path, f"is not a valid ArrayRecord file ({error})", REMEDY) from error
