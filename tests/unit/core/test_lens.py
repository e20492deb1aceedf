"""Lens distortion: there and back, and the straight image it leaves."""

import numpy as np
import pytest

from aomgen.core.lens import Lens

OPTICS = {"fx": 600.0, "fy": 590.0, "cx": 325.0, "cy": 236.0, "width": 640, "height": 480}
LENSES = [
    Lens(**OPTICS, k1=-0.32, k2=0.11, p1=0.001, p2=-0.002),
    Lens(**OPTICS, k1=0.08, k2=0.02),
    Lens(**OPTICS, p1=0.004, p2=0.003),
    Lens(**OPTICS),
]


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
    assert np.abs(straight.rays(lens.straightened(pixels)) - lens.rays(pixels)).max() < 1e-9


def test_a_pinhole_is_left_alone():
    lens = LENSES[-1]
    assert not lens.bends
    assert lens.straight() == lens
    assert lens.largest_shift_px() < 1e-9


def test_a_lens_that_folds_the_image_back_is_not_valid():
    assert all(lens.valid for lens in LENSES)
    assert not Lens(**OPTICS, k1=-1.4).valid
