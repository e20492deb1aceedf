"""Holes in pictures of surfaces that are known."""

import numpy as np

from aomgen.replacement.inpainting import continue_smoothly, inpaint


def test_inpainting_continues_color_and_texture():
    rng = np.random.default_rng(0)
    rows = np.arange(120)[:, None, None]
    image = 0.5 + 0.001 * rows + 0.08 * np.sin(np.arange(140) * 1.1)[None, :, None] * np.ones((120, 1, 3))
    known = np.ones((120, 140), bool)
    known[40:80, 50:100] = False
    result = inpaint(np.where(known[..., None], image, 0.0), known, rng)
    np.testing.assert_array_equal(result[known], image[known])
    filled = result[40:80, 50:100]
    assert np.abs(filled.mean(1) - image[40:80, 50:100].mean(1)).max() < 0.03
    assert filled.std(1).mean() > 0.6 * image[40:80, 50:100].std(1).mean()


def test_inpainting_nothing_gives_grey():
    assert (inpaint(np.zeros((40, 40, 3)), np.zeros((40, 40), bool), np.random.default_rng(0)) == 0.5).all()


def test_a_slope_goes_on_through_a_hole():
    slope = np.repeat(np.linspace(0.2, 0.8, 160)[None, :, None], 120, 0) * np.ones(3)
    known = np.ones((120, 160), bool)
    known[40:80, 60:100] = False
    smooth = continue_smoothly(np.where(known[..., None], slope, 0.0), known)
    assert np.abs(smooth - slope)[40:80, 60:100].max() < 0.04, "within a sixth of the slope"
