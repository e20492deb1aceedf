"""Label images of a demonstration video: all of them, of its size, or none."""

from pathlib import Path

import numpy as np
import pytest

from aomgen.capture.label_images import read_demo_masks
from aomgen.capture.read import read_capture
from aomgen.errors import IncompleteCaptureError, MalformedFileError
from aomgen.io.atomic import write_bytes
from aomgen.io.images import encode_png
from aomgen.pipeline.stages import capture_digest

SHAPE = (3, 480, 640)


def write_masks(capture: Path, frames: int, shape: tuple[int, int] = (480, 640)) -> None:
    folder = capture / "demo" / "masks" / "front"
    folder.mkdir(parents=True)
    for k in range(frames):
        write_bytes(folder / f"{k:04d}.png", encode_png(np.full(shape, k % 4, np.uint8)))


def test_there_need_not_be_any(sample: Path) -> None:
    capture = read_capture(sample)
    assert read_demo_masks(capture, capture.cameras[0], SHAPE) is None


def test_they_are_read_in_order_and_belong_to_the_capture(capture_copy: Path) -> None:
    before = capture_digest(read_capture(capture_copy))
    write_masks(capture_copy, 3)
    capture = read_capture(capture_copy)
    labels = read_demo_masks(capture, capture.cameras[0], SHAPE)
    assert labels is not None
    assert labels.shape == SHAPE
    assert labels[:, 0, 0].tolist() == [0, 1, 2]
    assert capture_digest(capture) != before


def test_one_too_few_is_refused(capture_copy: Path) -> None:
    write_masks(capture_copy, 2)
    capture = read_capture(capture_copy)
    with pytest.raises(IncompleteCaptureError, match="2 label images, the video 3 frames"):
        read_demo_masks(capture, capture.cameras[0], SHAPE)


def test_another_size_is_refused(capture_copy: Path) -> None:
    write_masks(capture_copy, 3, (24, 32))
    capture = read_capture(capture_copy)
    with pytest.raises(MalformedFileError, match=r"0000\.png.*\(32, 24\) px"):
        read_demo_masks(capture, capture.cameras[0], SHAPE)
