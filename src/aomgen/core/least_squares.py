"""Nonlinear least squares over a list of terms.

A term is one kind of evidence: residuals in their own unit, and the standard deviation of one residual in
that unit, which alone determines its weight against other evidence.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from aomgen.core.values import Array

StateT = TypeVar("StateT")
# Step of central differences, in the unit of an unknown: near the cube root of the machine precision.
_STEP = 1e-6
# Initial damping of Levenberg-Marquardt; it is small, because initial states are close to the solution.
_DAMPING = 1e-6
# Damping at which a rejected step is as small as rounding errors, so that the optimization ends.
_MAX_DAMPING = 1e8


@dataclass(frozen=True, slots=True, kw_only=True)
class Kernel:
    """Robust kernel that gives a residual r the weight `(1 + (r / scale)^2)^-power`.

    The power is 1/2 for a Huber-like kernel, 1 for Cauchy's, and 2 for that of Geman and McClure.

    Source: Barron, "A general and adaptive robust loss function", 2019.
    """

    scale: float
    power: float = 2.0

    def weights(self, residuals: Array) -> Array:
        """Compute the weights (m,) of residuals (m,)."""
        return (1 + (residuals / self.scale) ** 2) ** -self.power

    def costs(self, residuals: Array) -> Array:
        """Compute the costs (m,) that correspond to these weights; they are `r^2` for small residuals."""
        u = 1 + (residuals / self.scale) ** 2
        grown = np.log(u) if self.power == 1 else (u ** (1 - self.power) - 1) / (1 - self.power)
        return self.scale**2 * grown


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualTerm(Generic[StateT]):
    """One kind of evidence.

    Attributes:
        name: Key of the term in the solution.
        residual: Function from a state to residuals (m,).
        sd: Standard deviation of all residuals, or of each (m,), in their unit.
        kernel: Robust kernel in the unit of the residuals; None if there are no outliers.
        jacobian: Function from a state to the derivative (m, d) of the residuals with respect to a step; None for central
            differences.
    """

    name: str
    residual: Callable[[StateT], Array]
    sd: float | Array = 1.0
    kernel: Kernel | None = None
    jacobian: Callable[[StateT], Array] | None = None

    def cost(self, residuals: Array) -> float:
        """Compute the robust sum of squares, in units of the standard deviations."""
        costs = residuals**2 if self.kernel is None else self.kernel.costs(residuals)
        return float(np.sum(costs / np.square(self.sd)))

    def normal(self, residuals: Array, J: Array) -> tuple[Array, Array]:
        """Compute the information (d, d) and right-hand side (d,) of the normal equations of a step."""
        weights = np.ones_like(residuals) if self.kernel is None else self.kernel.weights(residuals)
        weighted = J.T * (weights / np.square(self.sd))
        return weighted @ J, -weighted @ residuals


@dataclass(frozen=True, slots=True, kw_only=True)
class Solution(Generic[StateT]):
    """State at the optimum, and the normal equations (d, d), (d,) of each term there, by its name."""

    state: StateT
    normals: dict[str, tuple[Array, Array]]

    @property
    def covariance(self) -> Array:
        """Covariance (d, d) of a step from the optimum; unknowns without evidence get 0."""
        A = np.sum([A for A, _ in self.normals.values()], axis=0)
        scale = 1 / np.sqrt(np.where(np.diag(A) > 0, np.diag(A), 1.0))
        return np.linalg.pinv(A * scale[:, None] * scale, hermitian=True) * scale[:, None] * scale

    def step_without(self, *names: str) -> Array:
        """Compute the step (d,) to the optimum of the other terms, to first order, if some terms are left out."""
        return _step([normal for key, normal in self.normals.items() if key not in names], 0.0)


def add(state: Array, step: Array) -> Array:
    """Add a step to a state that is a plain vector."""
    return state + step


def solve(
    terms: Sequence[ResidualTerm[StateT]],
    start: StateT,
    *,
    retract: Callable[[StateT, Array], StateT],
    dimension: int,
    max_iterations: int = 50,
    tolerance: float = 1e-9,
) -> Solution[StateT]:
    """Minimize the sum of robust squares of all terms, whose names are unique.

    Args:
        terms: All evidence.
        start: Initial state.
        retract: Function that moves a state by a step (d,); `add` for plain vectors.
        dimension: Number d of unknowns.
        max_iterations: Largest number of steps that are tried.
        tolerance: Relative decrease of the cost below which the optimization ends.

        Source: Levenberg-Marquardt algorithm with damping scaled by the diagonal.
    """
    state, damping = start, _DAMPING
    residuals = [term.residual(state) for term in terms]
    cost, normals = _cost(terms, residuals), _linearize(terms, state, residuals, retract, dimension)
    for _ in range(max_iterations):
        moved = retract(state, _step(normals, damping))
        there = [term.residual(moved) for term in terms]
        lower = _cost(terms, there)
        if lower <= cost:
            done = cost - lower <= tolerance * cost
            state, residuals, cost, damping = moved, there, lower, damping / 10
            normals = _linearize(terms, state, residuals, retract, dimension)
        else:
            damping *= 10
            done = damping > _MAX_DAMPING
        if done:
            break
    return Solution(state=state, normals={term.name: own for term, own in zip(terms, normals, strict=True)})


def jackknife_covariance(estimates: Array) -> Array:
    """Compute the jackknife covariance (d, d) from n estimates (n, d), each without one group. Source: Tukey, 1958."""
    apart = estimates - estimates.mean(0)
    return (len(estimates) - 1) / len(estimates) * apart.T @ apart


def _cost(terms: Sequence[ResidualTerm[StateT]], residuals: Sequence[Array]) -> float:
    return sum(term.cost(own) for term, own in zip(terms, residuals, strict=True))


def _linearize(
    terms: Sequence[ResidualTerm[StateT]],
    state: StateT,
    residuals: Sequence[Array],
    retract: Callable[[StateT, Array], StateT],
    dimension: int,
) -> list[tuple[Array, Array]]:
    """Compute the normal equations of each term; numeric derivatives share the moved states."""
    Js = [
        np.zeros((len(own), dimension)) if term.jacobian is None else term.jacobian(state)
        for term, own in zip(terms, residuals, strict=True)
    ]
    numeric = [(term, J) for term, J in zip(terms, Js, strict=True) if term.jacobian is None]
    for column in range(dimension if numeric else 0):
        step = _STEP * np.eye(dimension)[column]
        after, before = retract(state, step), retract(state, -step)
        for term, J in numeric:
            J[:, column] = (term.residual(after) - term.residual(before)) / (2 * _STEP)
    return [term.normal(own, J) for term, own, J in zip(terms, residuals, Js, strict=True)]


def _step(normals: Sequence[tuple[Array, Array]], damping: float) -> Array:
    """Compute the damped step (d,) of the summed normal equations; undetermined unknowns do not change."""
    A, b = np.sum([A for A, _ in normals], axis=0), np.sum([b for _, b in normals], axis=0)
    diagonal = np.where(np.diag(A) > 0, np.diag(A), 1.0)
    return np.linalg.solve(A + max(damping, 1e-12) * np.diag(diagonal), b)
