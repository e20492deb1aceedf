"""Rates of slip by direction."""

import numpy as np
import pytest

from aomgen.motion.joint_posterior import (
    SCALES,
    NoisePrior,
    PathNoise,
    compute_give_rate,
    compute_held_rate,
)

SIZES = np.array([0.0002, 0.0005, 0.004, 0.03, 0.016, 0.015, 0.001])


def test_a_direction_is_held_as_far_as_the_fingers_close_in_it() -> None:
    assert compute_held_rate(SIZES, 1.0) == pytest.approx(0.001)
    assert compute_held_rate(SIZES, 0.0) == pytest.approx(0.03)
    assert compute_held_rate(SIZES, 0.36) == pytest.approx(np.sqrt(0.36 * 0.001**2 + 0.64 * 0.03**2))


def test_a_firm_direction_varies_less() -> None:
    noise = PathNoise.of(np.linspace(0, 0.1, 8)[:, None] * [1.0, 0, 0], NoisePrior())
    held, loose = (noise.covariance("straight", SIZES, firm) for firm in (1.0, 0.0))
    np.testing.assert_allclose(loose, noise.covariance("bar", SIZES, 1.0))
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


def test_white_residuals_have_the_covariance_of_their_kind() -> None:
    noise = PathNoise.of(np.linspace(0, 0.1, 8)[:, None] * [1.0, 0, 0], NoisePrior())
    steps = np.zeros(len(SCALES))
    (white,), log_det = noise.whiten(["face"], steps, 1.0)
    covariance = noise.covariance("face", noise.prior.scales(steps), 1.0)
    np.testing.assert_allclose(white @ covariance @ white.T, np.eye(8), atol=1e-9)
    assert log_det == pytest.approx(np.linalg.slogdet(covariance)[1])
