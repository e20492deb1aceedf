"""The posterior of a joint model: fitted, with the sizes of its flaws, over what the shape suggests.

Every hint of the shape times every size of the flaws is a Gaussian with an evidence; together they are the answer,
and the evidence of a joint type is their sum.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, cast

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares, minimize
from scipy.special import ndtri
from scipy.stats import qmc

from aomgen.core.values import Array, freeze_arrays
from aomgen.motion.axis_prior import ANYWHERE, AxisHint
from aomgen.motion.joint_models import Prismatic, Revolute
from aomgen.motion.noise_model import SCALES, STEP_LIMITS, PathNoise

# Possibilities this many nats below the best are left out.
_NEGLIGIBLE = 7.0
# Points of the quadrature over the noise scales, in seven dimensions; each costs one linear solution a hint.
_SCALE_POINTS = 24
# A hint that pulls the axis farther than this from where the path puts it does not fit, [rad].
_MAX_TILT = 1.0
# Samples of the joint that are handed on; a 95 % interval read from them is good to some percent of itself.
_DRAWS = 512
# Relative gain of the cost below which a fit is done, some 1e-3 nats, and steps at most.
_TOLERANCE, _MAX_STEPS = 1e-5, 30


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """What is known of one joint type's unknowns.

    Attributes:
        model: The joint type.
        mean: Unknowns (P,).
        draws: Samples of the unknowns (S, P), equally likely.
        log_evidence: Of the type, up to a constant that all types share.
        scales: Sizes of the flaws (7,) at their likeliest, see `noise_model.SCALES`.
    """

    model: Revolute | Prismatic
    mean: Annotated[Array, "P"]
    draws: Annotated[Array, "S P"]
    log_evidence: float
    scales: Annotated[Array, "7"]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearizedModel:
    """A joint model under a hint, linear about unknowns `x` (P,).

    Attributes:
        model: The joint type.
        noise: Of the path.
        x: Unknowns.
        data: Residuals (C, K) and their Jacobian (C, K, P).
        prior: Residuals (Q,) in standard deviations and their Jacobian (Q, P).
        log_prior: Normalization of the prior.
    """

    model: Revolute | Prismatic
    noise: PathNoise
    x: Array
    data: tuple[Array, Array]
    prior: tuple[Array, Array]
    log_prior: float

    @staticmethod
    def of(model: Revolute | Prismatic, noise: PathNoise, hint: AxisHint, x: Array) -> "LinearizedModel":
        """By central differences."""
        steps = model.steps * 1e-3
        around = np.concatenate([x[None], x + np.diag(steps), x - np.diag(steps)])

        def differences(rows: Array) -> tuple[Array, Array]:
            ahead, behind = np.split(rows[1:], 2)
            return rows[0], np.moveaxis(ahead - behind, 0, -1) / (2 * steps)

        place = 0.0 if len(hint.across) else model.log_any_place(x)
        return LinearizedModel(
            model=model,
            noise=noise,
            x=x,
            data=differences(model.data(around)),
            prior=differences(_prior(model, hint, around)),
            log_prior=hint.log_density + place + model.log_beliefs,
        )

    def gaussian(self, steps: Array) -> tuple[float, Array, Array]:
        """Log evidence, mean (P,) and information (P, P) of the unknowns at given sizes of the flaws."""
        whiten, log_det = self.noise.whiten(self.model.kinds, steps, self.model.firmness)
        r = np.append(whiten @ self.data[0][..., None], self.prior[0])
        J = np.concatenate([(whiten @ self.data[1]).reshape(-1, len(self.x)), self.prior[1]])
        information, gradient = J.T @ J, J.T @ r
        step = -np.linalg.solve(information, gradient)
        cost = r @ r + gradient @ step + np.linalg.slogdet(information)[1] + log_det
        free = len(self.x) * np.log(2 * np.pi)
        return float(self.log_prior - 0.5 * (cost - free)), self.x + step, information

    def log_posterior(self, steps: Array) -> float:
        """Of the sizes of the flaws, the unknowns integrated out."""
        return self.gaussian(steps)[0] - 0.5 * float(steps @ steps)

    def likeliest(self, first: Array) -> Array:
        """Sizes of the flaws (7,), looked for from given ones."""
        result = minimize(
            lambda steps: -self.log_posterior(steps),
            first,
            method="L-BFGS-B",
            bounds=[STEP_LIMITS] * len(first),
            options={"maxiter": 15, "ftol": 1e-5},
        )
        return np.asarray(result.x, np.float64)

    def scale_points(self, center: Array) -> tuple[Array, Array]:
        """Even points (N, 7) over the sizes' posterior, with log weights (N,) that make them its integral."""
        h, size = 0.3, len(center)
        middle, unit = self.log_posterior(center), h * np.eye(size)
        around = [self.log_posterior(center + step) + self.log_posterior(center - step) for step in unit]
        curvature = (2 * middle - np.array(around)) / h**2
        sds = 1.1 / np.sqrt(np.clip(curvature, 0.5, None))
        normal = _normal_points(_SCALE_POINTS, size)
        points = np.clip(center + normal * sds, *STEP_LIMITS)
        log_ratio = 0.5 * (normal**2 - points**2).sum(1) + np.log(sds).sum()
        return points, log_ratio - np.log(len(points))


def compute_posterior(
    models: Sequence[Revolute | Prismatic], noise: PathNoise, hints: Sequence[AxisHint]
) -> Posterior:
    """What is known of one joint type.

    Args:
        models: The type, linearized about different first axes.
        noise: Of the path.
        hints: What the shape suggests; none of them may hold.
    """
    path, steps = fit_path(models, noise)
    model, x = path.model, path.x
    for _ in range(2):
        model, x = model.about(_fit(model, noise, ANYWHERE, steps, x))
        steps = LinearizedModel.of(model, noise, ANYWHERE, x).likeliest(steps)
    found = [LinearizedModel.of(model, noise, ANYWHERE, x)]
    for hint in hints:
        x_hint = _fit(model, noise, hint, steps, x)
        if np.abs(x_hint[:2]).max() < _MAX_TILT:
            found.append(LinearizedModel.of(model, noise, hint, x_hint))
    evidences = np.array([item.gaussian(steps)[0] for item in found])
    best = found[int(np.argmax(evidences))]
    steps = best.likeliest(steps)
    points, log_weights = best.scale_points(steps)
    kept = [
        item
        for item, evidence in zip(found, evidences, strict=True)
        if evidence > evidences.max() - _NEGLIGIBLE
    ]
    parts = [item.gaussian(point) for item in kept for point in points]
    logs = np.array([part[0] for part in parts]) + np.tile(log_weights, len(kept))
    log_evidence = float(np.logaddexp.reduce(logs))
    weights = np.exp(logs - log_evidence)
    return Posterior(
        model=model,
        mean=weights @ np.array([part[1] for part in parts]),
        draws=_draw(weights, parts),
        log_evidence=log_evidence,
        scales=noise.prior.scales(steps),
    )


def fit_path(models: Sequence[Revolute | Prismatic], noise: PathNoise) -> tuple[LinearizedModel, Array]:
    """The path alone, by the model whose first axis fits best, and the likeliest sizes of its flaws (7,)."""
    steps = np.zeros(len(SCALES))
    found = []
    for model in models:
        x = model.first()
        for _ in range(2):
            model, x = model.about(_fit(model, noise, ANYWHERE, steps, x))
        found.append(LinearizedModel.of(model, noise, ANYWHERE, x))
    best = max(found, key=lambda item: item.gaussian(steps)[0])
    return best, best.likeliest(steps)


def _fit(model: Revolute | Prismatic, noise: PathNoise, hint: AxisHint, steps: Array, first: Array) -> Array:
    """Unknowns (P,) that fit best at given sizes of the flaws."""
    whiten = noise.whiten(model.kinds, steps, model.firmness)[0]

    def residuals(x: Array) -> Array:
        return np.append(whiten @ model.data(x)[..., None], _prior(model, hint, x))

    def slopes(x: Array) -> Array:
        here = LinearizedModel.of(model, noise, hint, x)
        return np.concatenate([(whiten @ here.data[1]).reshape(-1, len(x)), here.prior[1]])

    limits = {"ftol": _TOLERANCE, "max_nfev": _MAX_STEPS}
    # Its type stubs know no function for a Jacobian.
    result = least_squares(residuals, first, cast(Any, slopes), method="lm", x_scale=model.steps, **limits)
    return np.asarray(result.x, np.float64)


def _prior(model: Revolute | Prismatic, hint: AxisHint, x: Array) -> Array:
    return np.concatenate([model.beliefs(x), hint.residuals(*model.lines(x))], axis=-1)


def _draw(weights: Array, parts: Sequence[tuple[float, Array, Array]]) -> Array:
    """Samples (S, P) of the mixture of Gaussians (log evidence, mean, information), evenly taken."""
    places = (np.arange(_DRAWS) + 0.5) / _DRAWS
    chosen = np.minimum(np.searchsorted(np.cumsum(weights), places), len(parts) - 1)
    draws = _normal_points(_DRAWS, len(parts[0][1]))
    for part in np.unique(chosen):
        _, mean, information = parts[part]
        L, mine = np.linalg.cholesky(information), chosen == part
        draws[mine] = mean + solve_triangular(L.T, draws[mine].T).T
    return draws


def _normal_points(count: int, size: int) -> Array:
    """Low-discrepancy points (count, size) of the standard normal distribution, always the same."""
    even = qmc.Halton(size, scramble=False).random(count + 1)[1:]
    return np.asarray(ndtri(even), np.float64)
