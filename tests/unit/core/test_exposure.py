"""Pictures of other exposure and white balance are brought to one."""

import numpy as np

from aomgen.core.exposure import change_exposure, fit_gains, match_frames


def test_known_gains_are_found_whatever_is_dark_or_clipped() -> None:
    rng = np.random.default_rng(1)
    seen = rng.integers(0, 255, (400, 3)).astype(np.uint8)
    gains = np.array([0.7, 1.0, 1.4])
    wanted = change_exposure(seen, gains)
    assert np.allclose(fit_gains(seen / 255, wanted / 255), gains, atol=0.01)


def test_gains_change_linear_colors() -> None:
    image = np.array([[[255, 188, 0]]], np.uint8)
    # 188 is half of white in linear light.
    assert change_exposure(image, np.array([0.5, 2.0, 1.0])).tolist() == [[[188, 255, 0]]]
    assert (change_exposure(image, np.ones(3)) == image).all()


def test_colors_that_cannot_be_compared_change_nothing() -> None:
    assert fit_gains(np.zeros((9, 3)), np.ones((9, 3))).tolist() == [1, 1, 1]


def test_frames_are_brought_to_one_exposure_and_strangers_are_named() -> None:
    rng = np.random.default_rng(0)
    picture = rng.uniform(60, 160, (48, 64, 3))
    gains = 1 + 0.15 * rng.uniform(-1, 1, 12)
    frames = picture * gains[:, None, None, None] + rng.normal(size=(12, 48, 64, 3))
    frames[5] = 255
    frames[8] = rng.uniform(0, 255, picture.shape)
    matched, bad = match_frames(
        frames.astype(np.uint8), np.zeros((12, 48, 64), bool), np.zeros((48, 64), bool)
    )
    assert np.flatnonzero(bad).tolist() == [5, 8]
    good = matched[~bad].astype(float)
    assert np.abs(good - good.mean(0)).mean() < 1.5
