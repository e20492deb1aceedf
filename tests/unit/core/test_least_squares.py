"""Known answers come back, beside outliers too, and with the covariance that noise gives."""

import numpy as np
import pytest

from aomgen.core.least_squares import Kernel, ResidualTerm, add, jackknife_covariance, solve
from aomgen.core.transforms import matrix_from_rotvec, rotvec_from_matrix
from aomgen.core.values import Array

TIMES = np.linspace(0, 3, 200)
TRUE = np.array([2.0, 0.7, -0.5])


def curve(x: Array) -> Array:
    return x[0] * np.exp(-x[1] * TIMES) + x[2]


def curve_jacobian(x: Array) -> Array:
    decay = np.exp(-x[1] * TIMES)
    return np.stack([decay, -x[0] * TIMES * decay, np.ones_like(TIMES)], 1)


def fit(values: Array, sd: float, *, analytic: bool = True, kernel: Kernel | None = None):
    term = ResidualTerm(
        name="curve",
        residual=lambda x: curve(x) - values,
        sd=sd,
        kernel=kernel,
        jacobian=curve_jacobian if analytic else None,
    )
    return solve([term], np.array([1.0, 0.2, 0.0]), retract=add, dimension=3)


@pytest.mark.parametrize("analytic", [True, False])
def test_a_curve_is_found_with_both_jacobians(analytic: bool) -> None:
    assert fit(curve(TRUE), 0.01, analytic=analytic).state == pytest.approx(TRUE, abs=1e-6)


def test_the_covariance_is_that_of_the_answers() -> None:
    rng = np.random.default_rng(0)
    found = [fit(curve(TRUE) + rng.normal(0, 0.05, len(TIMES)), 0.05) for _ in range(300)]
    spread = np.std([item.state for item in found], axis=0)
    assert spread == pytest.approx(np.sqrt(np.diag(found[0].covariance)), rel=0.15)


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_outliers_lose_their_weight(power: float) -> None:
    values = curve(TRUE) + np.random.default_rng(1).normal(0, 0.01, len(TIMES))
    values[::7] += 3.0
    kernel = Kernel(scale=0.05, power=power)
    assert np.abs(fit(values, 0.01).state - TRUE).max() > 0.3
    assert fit(values, 0.01, kernel=kernel).state == pytest.approx(TRUE, abs=0.05)


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_weights_are_the_slope_of_the_costs(power: float) -> None:
    kernel, r = Kernel(scale=0.7, power=power), np.linspace(-3, 3, 31)
    slope = (kernel.costs(r + 1e-6) - kernel.costs(r - 1e-6)) / 2e-6
    assert slope == pytest.approx(2 * kernel.weights(r) * r, abs=1e-6)


def test_terms_weigh_as_their_deviations_say() -> None:
    terms = [
        ResidualTerm(name="one", residual=lambda x: x - 1.0, sd=1.0),
        ResidualTerm(name="three", residual=lambda x: x - 3.0, sd=0.5),
    ]
    found = solve(terms, np.zeros(1), retract=add, dimension=1)
    assert found.state == pytest.approx([2.6])
    assert found.covariance == pytest.approx(np.array([[0.2]]))
    assert found.state + found.step_without("one") == pytest.approx([3.0], abs=1e-6)


def test_a_rotation_is_retracted_and_what_nothing_tells_stays() -> None:
    points = np.random.default_rng(2).normal(size=(9, 3))
    R_true = matrix_from_rotvec([0.8, -1.5, 0.9])
    term = ResidualTerm(name="points", residual=lambda state: (points @ (state[0] - R_true).T).ravel())
    found = solve(
        [term],
        (np.eye(3), 5.0),
        retract=lambda state, step: (matrix_from_rotvec(step[:3]) @ state[0], state[1] + step[3]),
        dimension=4,
    )
    assert rotvec_from_matrix(found.state[0] @ R_true.T) == pytest.approx(np.zeros(3), abs=1e-6)
    assert found.state[1] == 5.0
    assert np.all(np.isfinite(found.covariance))


def test_a_jackknife_of_means_is_the_error_of_the_mean() -> None:
    values = np.random.default_rng(3).normal(0, 2.0, (400, 1))
    left_out = np.array([np.delete(values, index, 0).mean(0) for index in range(400)])
    assert jackknife_covariance(left_out)[0, 0] == pytest.approx(values.var(ddof=1) / 400)
