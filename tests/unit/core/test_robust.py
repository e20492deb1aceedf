import numpy as np
import pytest
from scipy.stats import norm

from aomgen.core.robust import SD_OF_MAD, robust_sd


def test_normal_noise_keeps_its_deviation_beside_outliers():
    noise = np.random.default_rng(0).normal(0, 2.0, 100_000)
    noise[::50] = 1e6
    assert robust_sd(noise) == pytest.approx(2.0, rel=0.03)
    assert pytest.approx(1 / norm.ppf(0.75), abs=1e-4) == SD_OF_MAD
