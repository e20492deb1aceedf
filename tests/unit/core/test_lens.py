"""Lens distortion: there and back, and the straight image it leaves."""

import numpy as np
import pytest

from aomgen.core.lens import Lens, undistort_labels, undistorter

OPTICS = {"fx": 600.0, "fy": 590.0, "cx": 325.0, "cy": 236.0, "width": 640, "height": 480}
LENSES = [
    Lens(**OPTICS, k1=-0.32, k2=0.11, p1=0.001, p2=-0.002),
    Lens(**OPTICS, k1=0.08, k2=0.02),
    Lens(**OPTICS, p1=0.004, p2=0.003),
    Lens(**OPTICS),
]
PHOTOGRAPHED = Lens(fx=150.0, fy=150.0, cx=80.0, cy=60.0, width=160, height=120, k1=-0.25, k2=0.05)


@pytest.mark.parametrize("lens", LENSES)
def test_rays_undo_pixels(lens):
    pixels = np.random.default_rng(0).uniform([0, 0], [640, 480], (500, 2))
    assert np.abs(lens.pixels(lens.rays(pixels)) - pixels).max() < 1e-8


@pytest.mark.parametrize("lens", LENSES)
def test_the_straight_image_shows_only_what_was_photographed_and_touches_its_border(lens):
    source = lens.source_pixels()
    assert source.min() >= 0
    assert (source <= [640, 480]).all()
    edges = np.concatenate([source[0], source[-1], source[:, 0], source[:, -1]])
    assert min(edges.min(), (np.array([640, 480]) - edges).min()) < 1.5


@pytest.mark.parametrize("lens", LENSES)
def test_a_straightened_point_is_on_the_pinhole_cameras_ray(lens):
    pixels = np.random.default_rng(1).uniform([0, 0], [640, 480], (100, 2))
    straight = lens.straight()
    assert not straight.bends
    assert np.abs(straight.rays(lens.undistort(pixels)) - lens.rays(pixels)).max() < 1e-9


def test_a_pinhole_is_left_alone():
    lens = LENSES[-1]
    assert not lens.bends
    assert lens.straight() == lens
    assert lens.largest_shift_px() < 1e-9


def test_a_lens_that_folds_the_image_back_is_not_valid():
    assert all(lens.valid for lens in LENSES)
    assert not Lens(**OPTICS, k1=-1.4).valid


def _scene(rays: np.ndarray) -> np.ndarray:
    """A smooth pattern of viewing rays (N, 2), 0..255."""
    waves = 127 + 60 * np.sin(25 * rays[:, 0]) + 60 * np.cos(20 * rays[:, 1])
    return np.stack([waves, waves[::-1], 255 - waves], 1)


def _photograph(lens: Lens) -> np.ndarray:
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = lens.rays(np.stack([u.ravel(), v.ravel()], 1))
    return _scene(rays).reshape(lens.height, lens.width, 3).astype(np.uint8)


def test_the_straightened_photograph_is_what_a_pinhole_camera_sees():
    straight = undistorter(PHOTOGRAPHED)(_photograph(PHOTOGRAPHED)).astype(float)
    wanted = _photograph(PHOTOGRAPHED.straight()).astype(float)
    # The second channel runs over the rays backwards, which only the same rays would reproduce.
    difference = np.abs(straight - wanted)[..., [0, 2]]
    assert difference.max() <= 2
    assert np.abs(_photograph(PHOTOGRAPHED).astype(float) - wanted)[..., 0].max() > 30


def test_labels_take_the_nearest_label():
    labels = np.zeros((120, 160), np.uint8)
    labels[:, 80:] = 3
    straight = undistort_labels(labels, PHOTOGRAPHED)
    assert set(np.unique(straight)) == {0, 3}
    assert (straight[:, :79] == 0).all()
    assert (straight[:, 81:] == 3).all()
