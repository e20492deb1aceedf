"""The posterior of a joint model, given the errors of a gripper that moves a part.

The errors are noise of the log, slow slip, and rotation of the handle in the fingers (`path_noise`). Every axis prior
of the shape combined with every choice of noise scales gives a Gaussian with an evidence; their mixture is the
posterior, and the evidence of a joint type is their sum.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, cast

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares, minimize

from aomgen.core.quadrature import normal_points
from aomgen.core.values import Array, freeze_arrays
from aomgen.motion.joint_models import Prismatic, Revolute
from aomgen.motion.part_shape import UNIFORM_PRIOR, AxisPrior
from aomgen.motion.path_noise import SCALES, IndependentErrors, PathNoise

# Noise scales are searched within this many standard deviations of their medians.
STEP_LIMITS = (-3.0, 5.0)
# Hypotheses this many nats below the best are left out.
_NEGLIGIBLE = 7.0
# Points of the quadrature over the noise scales, in seven dimensions; each costs one linear solution.
_SCALE_POINTS = 24
# A prior that pulls the axis farther than this from the axis of the path does not fit, [rad].
_MAX_TILT = 1.0
# Number of samples of the joint in the result; a 95 % interval from them is accurate to a few percent.
_DRAWS = 512
# Relative decrease of the cost below which a fit has converged, about 1e-3 nats, and largest number of steps.
_TOLERANCE, _MAX_STEPS = 1e-5, 30


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """Posterior of the unknowns of one joint type.

    Attributes:
        draws: Samples of the unknowns, equally likely.
        log_evidence: Log evidence of the type, up to a constant that all types share.
        scales: Most likely noise scales.
    """

    model: Revolute | Prismatic
    mean: Annotated[Array, "P"]
    draws: Annotated[Array, "S P"]
    log_evidence: float
    scales: Annotated[Array, "7"]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearizedModel:
    """A joint model under an axis prior, linearized at unknowns `x` (P,).

    Attributes:
        data: Independent residuals (C, K) and their Jacobian (C, K, P).
        prior, log_prior: Residuals (Q,) in standard deviations, their Jacobian (Q, P), and their normalization.
    """

    model: Revolute | Prismatic
    errors: IndependentErrors
    x: Array
    data: tuple[Array, Array]
    prior: tuple[Array, Array]
    log_prior: float

    @staticmethod
    def of(model: Revolute | Prismatic, noise: PathNoise, hint: AxisPrior, x: Array) -> "LinearizedModel":
        """Linearize by central differences."""
        errors = noise.separate(model.kinds, model.closing_alignment)
        (residuals, slopes), prior = _linearize(model, hint, x)
        place = 0.0 if len(hint.across) else model.log_diffuse_position_prior(x)
        return LinearizedModel(
            model=model,
            errors=errors,
            x=x,
            data=((errors.rotations @ residuals[..., None])[..., 0], errors.rotations @ slopes),
            prior=prior,
            log_prior=hint.log_density + place + model.log_prior_norm,
        )

    def gaussian(self, steps: Array) -> tuple[float, Array, Array]:
        """Compute log evidence, mean (P,) and information (P, P) of the unknowns for given noise scales."""
        log_evidence, step, information, _ = self._solve(steps)
        return log_evidence, self.x + step, information

    def log_posterior(self, steps: Array) -> float:
        """Compute the log posterior of the noise scales, with the unknowns integrated out."""
        return self._solve(steps)[0] - 0.5 * float(steps @ steps)

    def log_posterior_slopes(self, steps: Array) -> Array:
        """Compute the derivatives (7,) of `log_posterior` by the scales."""
        _, step, information, (residuals, slopes) = self._solve(steps)
        shares = self.errors.variances(steps)
        count = shares[..., 0].size
        left = (residuals + slopes @ step)[:count]
        leverage = (slopes * np.linalg.solve(information, slopes.T).T).sum(1)[:count]
        surplus = (1 - left**2 - leverage) / shares.sum(-1).ravel()
        return -np.array(self.errors.prior.spreads) * (surplus @ shares.reshape(count, -1)) - steps

    def _solve(self, steps: Array) -> tuple[float, Array, Array, tuple[Array, Array]]:
        """Compute log evidence, step (P,) to the mean, information, and all white residuals with their Jacobian."""
        variances = self.errors.variances(steps).sum(-1)
        white = 1 / np.sqrt(variances)
        r = np.append(white * self.data[0], self.prior[0])
        J = np.concatenate([(white[..., None] * self.data[1]).reshape(-1, len(self.x)), self.prior[1]])
        information, gradient = J.T @ J, J.T @ r
        step = -np.linalg.solve(information, gradient)
        log_det = float(np.log(variances).sum()) + self.errors.log_volume
        cost = r @ r + gradient @ step + np.linalg.slogdet(information)[1] + log_det
        free = len(self.x) * np.log(2 * np.pi)
        return float(self.log_prior - 0.5 * (cost - free)), step, information, (r, J)

    def likeliest(self, first: Array) -> Array:
        """Find the most likely noise scales (7,), starting from given ones."""
        limits = {"bounds": [STEP_LIMITS] * len(first), "options": {"maxiter": 15, "ftol": 1e-5}}
        result = minimize(
            lambda steps: -self.log_posterior(steps),
            first,
            jac=lambda steps: -self.log_posterior_slopes(steps),
            method="L-BFGS-B",
            **limits,
        )
        return np.asarray(result.x, np.float64)

    def scale_points(self, center: Array) -> tuple[Array, Array]:
        """Sample even points (N, 7) of the scales' posterior, with log weights (N,) for its integral."""
        h, size = 0.3, len(center)
        middle, unit = self.log_posterior(center), h * np.eye(size)
        around = [self.log_posterior(center + step) + self.log_posterior(center - step) for step in unit]
        curvature = (2 * middle - np.array(around)) / h**2
        sds = 1.1 / np.sqrt(np.clip(curvature, 0.5, None))
        normal = normal_points(_SCALE_POINTS, size)
        points = np.clip(center + normal * sds, *STEP_LIMITS)
        log_ratio = 0.5 * (normal**2 - points**2).sum(1) + np.log(sds).sum()
        return points, log_ratio - np.log(len(points))


def compute_posterior(
    models: Sequence[Revolute | Prismatic], noise: PathNoise, hints: Sequence[AxisPrior]
) -> Posterior:
    """Compute the posterior of one joint type from its models about different first axes.

    The axis priors of the shape compete; possibly none of them holds.
    """
    path, steps = fit_path(models, noise)
    model, x = path.model, path.x
    for _ in range(2):
        model, x = model.about(_fit(model, noise, UNIFORM_PRIOR, steps, x))
        steps = LinearizedModel.of(model, noise, UNIFORM_PRIOR, x).likeliest(steps)
    found = [LinearizedModel.of(model, noise, UNIFORM_PRIOR, x)]
    for hint in hints:
        x_hint = _fit(model, noise, hint, steps, x)
        if np.abs(x_hint[:2]).max() < _MAX_TILT:
            found.append(LinearizedModel.of(model, noise, hint, x_hint))
    evidences = np.array([item.gaussian(steps)[0] for item in found])
    best = found[int(np.argmax(evidences))]
    steps = best.likeliest(steps)
    points, log_weights = best.scale_points(steps)
    kept = [found[k] for k in np.flatnonzero(evidences > evidences.max() - _NEGLIGIBLE)]
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
    """Fit the path alone by the model with the best first axis, and find its likeliest noise scales (7,)."""
    steps = np.zeros(len(SCALES))
    found = []
    for model in models:
        x = model.first()
        for _ in range(2):
            model, x = model.about(_fit(model, noise, UNIFORM_PRIOR, steps, x))
        found.append(LinearizedModel.of(model, noise, UNIFORM_PRIOR, x))
    best = max(found, key=lambda item: item.gaussian(steps)[0])
    return best, best.likeliest(steps)


def _fit(model: Revolute | Prismatic, noise: PathNoise, hint: AxisPrior, steps: Array, first: Array) -> Array:
    """Fit the unknowns (P,) for given noise scales."""
    errors = noise.separate(model.kinds, model.closing_alignment)
    whiten = errors.rotations / np.sqrt(errors.variances(steps).sum(-1, keepdims=True))

    def residuals(x: Array) -> Array:
        return np.append(whiten @ model.data(x)[..., None], _prior(model, hint, x))

    def slopes(x: Array) -> Array:
        (_, data), (_, prior) = _linearize(model, hint, x)
        return np.concatenate([(whiten @ data).reshape(-1, len(x)), prior])

    limits = {"ftol": _TOLERANCE, "max_nfev": _MAX_STEPS}
    # The type stubs of scipy do not accept a function as Jacobian.
    result = least_squares(residuals, first, cast(Any, slopes), method="lm", x_scale=model.steps, **limits)
    return np.asarray(result.x, np.float64)


def _linearize(
    model: Revolute | Prismatic, hint: AxisPrior, x: Array
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Compute data (C, K) and prior residuals (Q,), each with its Jacobian, by central differences."""
    steps = model.steps * 1e-3
    around = np.concatenate([x[None], x + np.diag(steps), x - np.diag(steps)])

    def differences(rows: Array) -> tuple[Array, Array]:
        ahead, behind = np.split(rows[1:], 2)
        return rows[0], np.moveaxis(ahead - behind, 0, -1) / (2 * steps)

    return differences(model.data(around)), differences(_prior(model, hint, around))


def _prior(model: Revolute | Prismatic, hint: AxisPrior, x: Array) -> Array:
    return np.concatenate([model.prior_residuals(x), hint.residuals(*model.lines(x))], axis=-1)


def _draw(weights: Array, parts: Sequence[tuple[float, Array, Array]]) -> Array:
    """Sample (S, P) from the mixture of Gaussians (log evidence, mean, information) with low discrepancy."""
    places = (np.arange(_DRAWS) + 0.5) / _DRAWS
    chosen = np.minimum(np.searchsorted(np.cumsum(weights), places), len(parts) - 1)
    draws = normal_points(_DRAWS, len(parts[0][1]))
    for part in np.unique(chosen):
        _, mean, information = parts[part]
        L, mine = np.linalg.cholesky(information), chosen == part
        draws[mine] = mean + solve_triangular(L.T, draws[mine].T).T
    return draws
