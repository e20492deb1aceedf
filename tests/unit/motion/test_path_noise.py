"""Rates of slip by direction, and covariances of a path's errors."""

import numpy as np
import pytest

from aomgen.motion.path_noise import (
    BEND_SHARE,
    SCALES,
    NoisePrior,
    PathNoise,
    compute_give_rate,
    compute_held_rate,
)

NOISE = PathNoise.of(np.linspace(0, 0.1, 8)[:, None] * [1.0, 0, 0], NoisePrior())
SIZES = np.array([0.0002, 0.0005, 0.004, 0.03, 0.016, 0.015, 0.001])


def test_a_direction_is_held_as_far_as_the_fingers_close_in_it() -> None:
    assert compute_held_rate(SIZES, 1.0) == pytest.approx(0.001)
    assert compute_held_rate(SIZES, 0.0) == pytest.approx(0.03)
    assert compute_held_rate(SIZES, 0.36) == pytest.approx(np.sqrt(0.36 * 0.001**2 + 0.64 * 0.03**2))


def covariances(kinds: list[str], steps: np.ndarray, closing_alignment: float) -> np.ndarray:
    """Covariances (C, 8, 8) of residuals along a straight path of 10 cm."""
    errors = NOISE.separate(kinds, closing_alignment)
    inverse = np.linalg.inv(errors.rotations)
    return inverse * errors.variances(steps).sum(-1)[:, None] @ inverse.swapaxes(1, 2)


def test_a_firm_direction_varies_less() -> None:
    steps = np.log(SIZES / NOISE.prior.medians) / NOISE.prior.spreads
    (held,), (loose, bar) = (
        covariances(["straight"], steps, 1.0),
        covariances(["straight", "bar"], steps, 0.0),
    )
    np.testing.assert_allclose(loose, bar, atol=1e-15)
    assert held[-1, -1] == pytest.approx((0.001 * 0.1) ** 2 + 0.0002**2, rel=1e-6)


def test_a_hand_that_slides_gives_way_unless_its_fingers_close_along_the_way() -> None:
    calm = SIZES.copy()
    calm[SCALES.index("bar")] = 0.0
    for joint_type in ("prismatic", "revolute"):
        assert compute_give_rate(joint_type, SIZES, 1.0) == compute_give_rate(joint_type, calm, 0.0)
        assert compute_give_rate(joint_type, SIZES, 0.0) > compute_give_rate(joint_type, SIZES, 0.9)


def test_a_hand_that_holds_nothing_slides_evenly_without_telling() -> None:
    noise = NoisePrior()
    free = noise.loosen()
    usual, loose = (dict(zip(SCALES, item.medians, strict=True)) for item in (noise, free))
    assert loose["straight"] > 10 * usual["straight"]
    assert loose["bar"] > 5 * usual["bar"]
    assert free.spreads[-1] < 0.2 < noise.spreads[-1]
    assert all(loose[name] == usual[name] for name in ("place", "turn", "tilt", "pivot"))


@pytest.mark.parametrize("noise", [NOISE, NOISE.loosen(slice(6, 8))], ids=["held", "loosened"])
def test_covariances_are_a_course_and_white_noise(noise: PathNoise) -> None:
    steps = np.linspace(-1, 1, len(SCALES))
    sizes = dict(zip(SCALES, noise.prior.scales(steps), strict=True))
    errors = noise.separate(["face", "pivot"], 1.0)
    s, white = noise.travel_m, np.diag(noise.inflation**2)
    face = sizes["face"] ** 2 * (np.outer(s, s) + (BEND_SHARE * s[-1]) ** 2 * noise.waves)
    pivot = (sizes["pivot"] * s[-1]) ** 2 * noise.waves
    expected = [face + sizes["place"] ** 2 * white, pivot + sizes["turn"] ** 2 * white]
    variances = errors.variances(steps).sum(-1)
    whiten = errors.rotations / np.sqrt(variances[..., None])
    for matrix, covariance in zip(whiten, expected, strict=True):
        np.testing.assert_allclose(matrix @ covariance @ matrix.T, np.eye(8), atol=1e-9)
    log_det = np.log(variances).sum() + errors.log_volume
    assert log_det == pytest.approx(np.linalg.slogdet(expected)[1].sum())
