import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aomgen.datasets.records import (
    decode_example,
    encode_example,
    mask_crc,
    read_records,
    records_bytes,
)
from aomgen.errors import MalformedFileError, MissingFileError


def unmasked(masked: int) -> int:
    """The CRC behind TensorFlow's mask, as its documentation tells to undo it."""
    turned = (masked - 0xA282EAD8) & 0xFFFFFFFF
    return (turned >> 17 | turned << 15) & 0xFFFFFFFF


@pytest.mark.parametrize(
    ("data", "crc"),
    [
        # RFC 3720, B.4: zeros, ones, up, down; then the check value of CRC-32C.
        (bytes(32), 0x8A9136AA),
        (b"\xff" * 32, 0x62A8AB43),
        (bytes(range(32)), 0x46DD794E),
        (bytes(range(31, -1, -1)), 0x113FDB5C),
        (b"123456789", 0xE3069283),
        (b"", 0),
    ],
)
def test_crc_of_known_vectors(data, crc):
    assert unmasked(mask_crc(data)) == crc


def test_a_record_is_framed_as_tensorflow_does():
    data = records_bytes([b"abc"])
    assert data[:8] == struct.pack("<Q", 3)
    assert data[8:12] == struct.pack("<I", mask_crc(data[:8]))
    assert data[12:15] == b"abc"
    assert data[15:] == struct.pack("<I", mask_crc(b"abc"))


@given(st.lists(st.binary(max_size=300), max_size=5))
def test_records_come_back(tmp_path_factory, records):
    path = tmp_path_factory.mktemp("r") / "shard"
    path.write_bytes(records_bytes(records))
    assert list(read_records(path)) == records


@given(
    st.dictionaries(
        st.text(max_size=20),
        st.one_of(
            st.lists(st.binary(max_size=40), min_size=1, max_size=4),
            st.lists(st.floats(width=32, allow_nan=False), min_size=1, max_size=9).map(
                lambda values: np.array(values, np.float32)
            ),
            st.lists(st.integers(-(2**63), 2**63 - 1), min_size=1, max_size=9).map(
                lambda values: np.array(values, np.int64)
            ),
        ),
        max_size=4,
    )
)
def test_examples_come_back(tmp_path_factory, features):
    found = decode_example(encode_example(features), tmp_path_factory.getbasetemp())
    assert set(found) == set(features)
    for name, value in features.items():
        if isinstance(value, list):
            assert found[name] == value
        else:
            np.testing.assert_array_equal(found[name], value)


def test_an_example_has_the_bytes_that_tensorflow_writes():
    # tf.train.Example with the feature "a": int64_list [1, 300], serialized by TensorFlow 2.21.
    wanted = bytes.fromhex("0a0e0a0c0a016112071a050a0301ac02")
    assert encode_example({"a": np.array([1, 300])}) == wanted


@pytest.mark.parametrize("kept", [3, 11, 13, 20, 30, -1])
def test_a_cut_shard_is_refused(tmp_path, kept):
    path = tmp_path / "shard"
    path.write_bytes(records_bytes([b"first record", b"second record"])[:kept])
    with pytest.raises(MalformedFileError, match=r"ends inside record [01]"):
        list(read_records(path))


@pytest.mark.parametrize(("place", "record"), [(0, 0), (9, 0), (15, 0), (25, 0), (30, 1), (45, 1)])
def test_a_wrong_crc_is_refused(tmp_path, place, record):
    data = bytearray(records_bytes([b"first record", b"second record"]))
    data[place] ^= 4
    path = tmp_path / "shard"
    path.write_bytes(data)
    with pytest.raises(MalformedFileError, match=f"record {record} does not match its CRC"):
        list(read_records(path))


def test_no_shard_is_refused(tmp_path):
    with pytest.raises(MissingFileError):
        list(read_records(tmp_path / "none"))


@given(st.binary(max_size=60))
def test_noise_is_an_example_or_refused(tmp_path_factory, data):
    try:
        decode_example(data, tmp_path_factory.getbasetemp())
    except MalformedFileError:
        return
