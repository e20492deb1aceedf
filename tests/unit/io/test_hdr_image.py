"""Pictures of light come back as they were, and bad ones are refused in one sentence."""

import fractions
from pathlib import Path

import av
import numpy as np
import pytest

from aomgen.errors import InputError, LimitExceededError, MalformedFileError, MissingFileError, NonFiniteError
from aomgen.io import hdr_image
from aomgen.io.hdr_image import read_environment
from aomgen.io.images import encode_png


def encoded(radiance: np.ndarray, codec: str) -> bytes:
    encoder = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height = radiance.shape[1], radiance.shape[0]
    encoder.pix_fmt, encoder.time_base = "gbrpf32le", fractions.Fraction(1)
    frame = av.VideoFrame.from_ndarray(radiance.astype(np.float32), format="gbrpf32le")
    return b"".join(bytes(packet) for packet in [*encoder.encode(frame), *encoder.encode(None)])


def room(height: int = 16, width: int = 32) -> np.ndarray:
    radiance = np.random.default_rng(0).uniform(0.2, 1.0, (height, width, 3))
    radiance[1, 1] = (3000.0, 2000.0, 1000.0)
    return radiance


@pytest.mark.parametrize("codec", ["hdr", "pfm"])
def test_a_picture_of_light_comes_back(tmp_path: Path, codec: str) -> None:
    path = tmp_path / f"room.{codec}"
    path.write_bytes(encoded(room(), codec))
    found = read_environment(path).radiance_linear
    # Three numbers share an exponent: the error is a share of the largest.
    assert (np.abs(found - room()) <= room().max(-1, keepdims=True) / 127).all()


def damaged(value: float) -> bytes:
    radiance = room()
    radiance[3, 3, 1] = value
    return encoded(radiance, "pfm")


BAD: dict[str, tuple[bytes, type[InputError], str]] = {
    "truncated": (encoded(room(), "hdr")[:-300], MalformedFileError, "not a readable HDR image"),
    "text": (b"#?RADIANCE\nhello\n", LimitExceededError, "or names no size"),
    "empty": (b"", MalformedFileError, "not a readable HDR image"),
    "png": (encode_png(np.zeros((16, 32, 3), np.uint8)), MalformedFileError, "but png; save it as"),
    "square": (encoded(room(32, 32), "hdr"), MalformedFileError, "has 32 x 32 pixels, expected 2:1"),
    "black": (encoded(0 * room(), "hdr"), MalformedFileError, "is black"),
    "nan": (damaged(np.nan), NonFiniteError, "holds NaN or infinite"),
    "infinite": (damaged(np.inf), NonFiniteError, "holds NaN or infinite"),
    "negative": (damaged(-2.0), MalformedFileError, r"negative light \(-2\)"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_picture_is_refused(tmp_path: Path, name: str) -> None:
    data, kind, words = BAD[name]
    (tmp_path / "room.hdr").write_bytes(data)
    with pytest.raises(kind, match=words):
        read_environment(tmp_path / "room.hdr")


def test_missing_and_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MissingFileError, match=r"room\.hdr: is missing"):
        read_environment(tmp_path / "room.hdr")
    (tmp_path / "room.hdr").write_bytes(encoded(room(), "hdr"))
    monkeypatch.setattr(hdr_image, "MAX_PIXELS", 500)
    with pytest.raises(LimitExceededError, match="more than 500 pixels"):
        read_environment(tmp_path / "room.hdr")
