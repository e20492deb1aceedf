"""Images of any depth and number of channels come as 8-bit colors."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from aomgen.importers.photos import read_header
from aomgen.io.images import image_size, opacity_of, read_image


@pytest.mark.parametrize(
    ("pixels", "want"),
    [
        (np.full((2, 2), 25700, np.uint16), (100, 100, 100, 255)),
        (np.full((2, 2), 100, np.uint8), (100, 100, 100, 255)),
        (np.full((2, 2, 2), (100, 40), np.uint8), (100, 100, 100, 40)),
        (np.full((2, 2, 4), (10, 20, 30, 40), np.uint8), (10, 20, 30, 40)),
    ],
)  # fmt: skip
def test_16_bits_grey_and_alpha_are_read_right(tmp_path: Path, pixels: np.ndarray, want) -> None:
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert read_image(tmp_path / "a.png", "RGBA")[0, 0].tolist() == list(want)
    assert read_image(tmp_path / "a.png")[0, 0].tolist() == list(want[:3])


@pytest.mark.parametrize("exif", [b"garbage", b"MM\0*\0"])
def test_damaged_exif_data_are_ignored(tmp_path: Path, exif: bytes) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(np.zeros((2, 3, 3), np.uint8)).save(path, exif=exif)
    assert image_size(path) == (3, 2)
    assert read_image(path).shape == (2, 3, 3)
    assert read_header(path) == ((3, 2), 0.0)


def test_opacity_is_alpha_or_else_brightness() -> None:
    assert opacity_of(np.full((1, 1, 4), (90, 90, 90, 7), np.uint8))[0, 0] == 7
    assert opacity_of(np.full((1, 1, 4), (90, 90, 90, 255), np.uint8))[0, 0] == 90
