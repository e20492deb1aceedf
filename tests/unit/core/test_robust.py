import numpy as np
import pytest
from scipy.stats import norm

from aomgen.core.robust import SD_OF_MAD, compute_masked_median, regress_robustly, robust_sd


def test_normal_noise_keeps_its_deviation_beside_outliers():
    noise = np.random.default_rng(0).normal(0, 2.0, 100_000)
    noise[::50] = 1e6
    assert robust_sd(noise) == pytest.approx(2.0, rel=0.03)
    assert pytest.approx(1 / norm.ppf(0.75), abs=1e-4) == SD_OF_MAD


def test_outliers_do_not_bend_a_line() -> None:
    rng = np.random.default_rng(2)
    x = rng.uniform(0, 1, 200)
    y = 0.3 * x + 0.1 + rng.normal(0, 0.01, 200)
    y[::5] += 1.0
    (slope, offset), weights, sd = regress_robustly(np.stack([x, np.ones(200)], 1), y, 0.001)
    assert slope == pytest.approx(0.3, abs=0.02)
    assert offset == pytest.approx(0.1, abs=0.02)
    assert sd < 0.03
    assert weights[::5].max() < 0.1


def test_a_masked_median_knows_where_it_knows_nothing() -> None:
    values = np.array([[1.0, 5.0], [2.0, 6.0], [90.0, 7.0]])
    known = np.array([[True, False], [True, False], [False, False]])
    median, some = compute_masked_median(values, known)
    assert median.tolist() == [1.5, 0.0]
    assert some.tolist() == [True, False]
