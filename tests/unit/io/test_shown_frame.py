"""Tone mapping keeps what a screen shows and agrees with the curves of the standards."""

import numpy as np
import pytest

from aomgen.io.shown_frame import tone_map

# Signals of one luminance in both curves, from BT.2408-7, table 1: grey card, white page.
SAME_LUMINANCE = [(0.38, 0.38), (0.75, 0.58)]


def grey(level: float) -> np.ndarray:
    return np.full((1, 1, 3), round(65535 * level), np.uint16)


@pytest.mark.parametrize(("hlg", "pq"), SAME_LUMINANCE)
def test_one_luminance_is_one_grey(hlg, pq):
    ours, theirs = tone_map(grey(hlg), "HLG")[0, 0], tone_map(grey(pq), "PQ")[0, 0]
    assert np.ptp(ours.astype(int)) <= 1
    assert np.abs(ours.astype(int) - theirs).max() <= 3


def test_a_grey_card_keeps_its_grey():
    # 18 % of white, 26 cd/m^2 of 203, is 12.8 % of the white page; sRGB gives 0.394 for it.
    assert tone_map(grey(0.38), "HLG")[0, 0, 0] == pytest.approx(255 * 0.394, abs=2)


@pytest.mark.parametrize("transfer", ["HLG", "PQ"])
def test_brighter_stays_brighter_and_nothing_clips_below_the_peak(transfer):
    ramp = np.linspace(0, 65535, 257).astype(np.uint16)
    shown = tone_map(np.repeat(ramp[None, :, None], 3, 2), transfer)[0, :, 1].astype(int)
    assert (np.diff(shown) >= 0).all()
    assert shown[0] == 0
    assert 240 <= shown[round(256 * (0.75 if transfer == "HLG" else 0.58))] <= 250
    assert shown[-1] == 255


def test_a_wide_red_stays_red():
    red = np.array([[[40000, 0, 0]]], np.uint16)
    shown = tone_map(red, "HLG")[0, 0].astype(int)
    assert shown[0] > 150
    assert shown[1:].max() == 0
