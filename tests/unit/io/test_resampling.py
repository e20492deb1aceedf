"""Straightened pictures show straight lines, and labels stay labels."""

import numpy as np

from aomgen.core.lens import Lens
from aomgen.io.resampling import undistort_labels, undistorter

LENS = Lens(fx=150.0, fy=150.0, cx=80.0, cy=60.0, width=160, height=120, k1=-0.25, k2=0.05)


def _scene(rays: np.ndarray) -> np.ndarray:
    """A smooth pattern of viewing rays (N, 2), 0..255."""
    waves = 127 + 60 * np.sin(25 * rays[:, 0]) + 60 * np.cos(20 * rays[:, 1])
    return np.stack([waves, waves[::-1], 255 - waves], 1)


def _photograph(lens: Lens) -> np.ndarray:
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = lens.rays(np.stack([u.ravel(), v.ravel()], 1))
    return _scene(rays).reshape(lens.height, lens.width, 3).astype(np.uint8)


def test_the_straightened_photograph_is_what_a_pinhole_camera_sees():
    straight = undistorter(LENS)(_photograph(LENS)).astype(float)
    wanted = _photograph(LENS.straight()).astype(float)
    # The second channel runs over the rays backwards, which only the same rays would reproduce.
    difference = np.abs(straight - wanted)[..., [0, 2]]
    assert difference.max() <= 2
    assert np.abs(_photograph(LENS).astype(float) - wanted)[..., 0].max() > 30


def test_labels_take_the_nearest_label():
    labels = np.zeros((120, 160), np.uint8)
    labels[:, 80:] = 3
    straight = undistort_labels(labels, LENS)
    assert set(np.unique(straight)) == {0, 3}
    assert (straight[:, :79] == 0).all()
    assert (straight[:, 81:] == 3).all()
