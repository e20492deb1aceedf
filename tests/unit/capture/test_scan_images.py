"""Blurred pictures are told from sharp ones, noise or not."""

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import correlate, gaussian_filter

from aomgen.capture.scan_images import BLURRED, blur, read_grey, shrink

MOTION_PX = 15


@pytest.fixture
def picture(sample) -> np.ndarray:
    """Grey levels (480, 640)."""
    return np.asarray(Image.open(sample / "scan" / "0017.jpg").convert("L"), np.float32)


def measured(picture: np.ndarray) -> float:
    return blur(shrink(Image.fromarray(np.clip(picture, 0, 255).astype(np.uint8))))


def test_sharp_pictures(sample):
    assert max(blur(read_grey(path)) for path in sorted((sample / "scan").iterdir())[::8]) < BLURRED - 0.1


@pytest.mark.parametrize("noise", [0.0, 2.0])
@pytest.mark.parametrize("sigma", [3, 6])
def test_out_of_focus(picture, sigma, noise):
    rng = np.random.default_rng(0)
    assert measured(gaussian_filter(picture, sigma) + rng.normal(0, noise, picture.shape)) > BLURRED


@pytest.mark.parametrize(
    "kernel", [np.ones((1, MOTION_PX)), np.ones((MOTION_PX, 1)), np.eye(MOTION_PX)[:, ::-1]]
)
def test_moved_camera(picture, kernel):
    assert measured(correlate(picture, kernel / kernel.sum())) > BLURRED


def test_a_little_softness_passes(picture):
    assert measured(gaussian_filter(picture, 1)) < BLURRED


def test_an_empty_picture_is_not_sharp():
    dark = np.random.default_rng(0).normal(10, 1, (240, 320))
    assert measured(dark) == 1
