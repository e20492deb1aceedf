"""A fixed camera that was pushed is told from one before which an arm moves."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from aomgen.capture.demo_videos import find_push
from aomgen.io.video import Video


def film(pushed_px: int) -> Video:
    """A textured room and a box that crosses it; from the middle on the room lies elsewhere."""
    rng = np.random.default_rng(3)
    room = 128 + 4 * gaussian_filter(rng.normal(0, 60, (240, 340)), 1.5)
    box = 128 + 4 * gaussian_filter(rng.normal(0, 60, (80, 60)), 1.5)
    frames = []
    for k in range(40):
        shift = pushed_px if k >= 20 else 0
        frame = room[:, 10 - shift : 330 - shift].copy()
        frame[90:170, 5 * k + 20 : 5 * k + 80] = box
        frames.append(frame + rng.normal(0, 4, frame.shape))
    gray = np.stack(frames).clip(0, 255).astype(np.uint8)
    return Video(times_s=np.arange(40) / 10, frames_srgb=np.repeat(gray[..., None], 3, axis=3), fps=10.0)


def test_a_moving_arm_is_no_push():
    assert find_push(film(0)) is None


@pytest.mark.parametrize("pushed_px", [-7, 3, 8])
def test_a_push_is_found_with_its_time_and_size(pushed_px):
    push = find_push(film(pushed_px))
    assert push is not None
    time_s, share = push
    assert time_s == pytest.approx(2.1, abs=0.3)
    assert share == pytest.approx(abs(pushed_px) / 320, abs=0.002)
