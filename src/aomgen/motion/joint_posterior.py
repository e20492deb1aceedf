"""The posterior of a joint model: fitted, with the sizes of its flaws, over what the shape suggests.

Every possibility (no hint, or one of the hints) times every size of the flaws is a Gaussian with an
evidence; together they are the answer, and the evidence of a joint type is their sum.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.special import ndtri
from scipy.stats import qmc

from aomgen.core.values import Array, freeze
from aomgen.motion.axis_prior import NEITHER, AxisHint
from aomgen.motion.joint_models import LOG_ANY_DIRECTION, Prismatic, Revolute
from aomgen.motion.noise_model import SCALES, STEP_LIMITS, NoisePrior, PathNodes, factorize_covariances

JointModel = Revolute | Prismatic
# Possibilities this many nats below the best are left out.
_NEGLIGIBLE = 7.0
# Points of the quadrature over the noise scales, in seven dimensions; each costs one linear solution a hint.
_SCALE_POINTS = 24
# A hint that pulls the axis farther than this from where the path puts it does not fit, [rad].
_MAX_TILT = 1.0
# Samples of the joint that are handed on; a 95 % interval read from them is good to some percent of itself.
_DRAWS = 512
# Levenberg-Marquardt steps at most; it ends earlier where a step gains less than 1e-4.
_ROUNDS = 30


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearizedModel:
    """Linear model at one set of unknowns.

    Attributes:
        data: Residuals (C, K) and their Jacobian (C, K, P).
        prior: Residuals (Q,) in standard deviations and their Jacobian (Q, P).
        log_prior: Normalization of the prior.
    """

    data: tuple[Array, Array]
    prior: tuple[Array, Array]
    log_prior: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """What is known of one joint type's unknowns.

    Attributes:
        model: The joint type.
        mean: Unknowns (P,).
        draws: Samples of the unknowns (S, P), equally likely.
        log_evidence: Of the type, up to a constant that all types share.
        scales: Sizes of the flaws (7,) at their likeliest, see `joint_noise.SCALES`.
    """

    model: JointModel
    mean: Array
    draws: Array
    log_evidence: float
    scales: Array

    def __post_init__(self) -> None:
        freeze(self, "mean", self.mean, (len(self.model.steps),))
        freeze(self, "draws", self.draws, (None, len(self.mean)))
        freeze(self, "scales", self.scales, (len(SCALES),))


def solve(
    model: JointModel, path_nodes: PathNodes, scales: Array, hint: AxisHint | None, first: Array
) -> Array:
    """Unknowns (P,) that fit best at given sizes of the flaws.

    Source: Levenberg, 1944; Marquardt, 1963.
    """
    known = factorize_covariances(path_nodes, scales, model.firmness)
    whiten = np.stack([known[kind][0] for kind in model.kinds])

    def at(x: Array) -> tuple[float, Array, Array]:
        r, J = _slopes(model, hint, x, whiten)
        return float(r @ r), J.T @ J, J.T @ r

    x = first
    cost, information, gradient = at(x)
    damping = 1e-3
    for _ in range(_ROUNDS):
        step = -np.linalg.solve(information + damping * np.diag(1e-12 + np.diag(information)), gradient)
        tried = at(x + step)
        if not tried[0] < cost:
            damping *= 10
            if damping > 1e6:
                break
            continue
        gained = cost - tried[0]
        x, (cost, information, gradient), damping = x + step, tried, max(damping / 10, 1e-9)
        if gained < 1e-4:
            break
    return x


def _slopes(
    model: JointModel, hint: AxisHint | None, x: Array, whiten: Array | None = None
) -> tuple[Array, Array]:
    """All residuals (N,), white ones first, and their central differences (N, P)."""
    steps = model.steps * 1e-3
    around = np.concatenate([x[None], x + np.diag(steps), x - np.diag(steps)])
    data = model.data(around)
    if whiten is not None:
        data = (whiten @ data[..., None])[..., 0]
    rows = np.concatenate([data.reshape(len(around), -1), _prior_residuals(model, hint, around)], axis=1)
    ahead, behind = np.split(rows[1:], 2)
    return rows[0], ((ahead - behind) / (2 * steps[:, None])).T


def _prior_residuals(model: JointModel, hint: AxisHint | None, x: Array) -> Array:
    own = model.beliefs(x)
    if hint is None:
        return own
    return np.concatenate([own, hint.residuals(*model.lines(x))], axis=-1)


def linearize_model(model: JointModel, hint: AxisHint | None, x: Array) -> LinearizedModel:
    """Residuals and central differences at `x`."""
    rows, slopes = _slopes(model, hint, x)
    channels = len(model.kinds)
    size = channels * len(model.turns_world)
    shape = (channels, len(model.turns_world))
    if hint is None:
        log_prior = np.log(NEITHER) + LOG_ANY_DIRECTION + model.log_any_place(x)
    else:
        log_prior = hint.log_density + (0.0 if len(hint.across) else model.log_any_place(x))
    return LinearizedModel(
        data=(rows[:size].reshape(shape), slopes[:size].reshape(*shape, -1)),
        prior=(rows[size:], slopes[size:]),
        log_prior=float(log_prior) + model.log_beliefs,
    )


def integrate_gaussian(
    model: JointModel, evidence: LinearizedModel, path_nodes: PathNodes, scales: Array
) -> tuple[float, Array, Array]:
    """Log evidence, step (P,) to the mean and information (P, P) at given sizes of the flaws."""
    known = factorize_covariances(path_nodes, scales, model.firmness)
    (rows, slopes), (beliefs, lean) = evidence.data, evidence.prior
    whiten = np.stack([known[kind][0] for kind in model.kinds])
    r = np.concatenate([(whiten @ rows[..., None]).ravel(), beliefs])
    J = np.concatenate([(whiten @ slopes).reshape(-1, len(model.steps)), lean])
    information, gradient = J.T @ J, J.T @ r
    step = -np.linalg.solve(information, gradient)
    cost = float(r @ r + gradient @ step + np.linalg.slogdet(information)[1])
    cost += sum(known[kind][1] for kind in model.kinds)
    free = len(model.steps) * np.log(2 * np.pi)
    return -0.5 * (cost - free) + evidence.log_prior, np.asarray(step, np.float64), information


def compute_posterior(
    models: list[JointModel], path_nodes: PathNodes, noise: NoisePrior, hints: list[AxisHint]
) -> Posterior:
    """What is known of one joint type.

    Args:
        models: The type, linearized about different first axes.
        path_nodes: Nodes of the path.
        noise: Usual sizes of the flaws.
        hints: What the shape suggests; none of them may hold.
    """
    steps, model, x = fit_path(models, path_nodes, noise)[1:]
    for _ in range(2):
        model, x = model.about(solve(model, path_nodes, noise.scales(steps), None, x))
        steps = _likeliest(model, linearize_model(model, None, x), path_nodes, noise, steps)
    found = []
    for hint in (None, *hints):
        x_hint = x if hint is None else solve(model, path_nodes, noise.scales(steps), hint, x)
        if hint is not None and not np.abs(x_hint[:2]).max() < _MAX_TILT:
            continue
        evidence = linearize_model(model, hint, x_hint)
        found.append(
            (integrate_gaussian(model, evidence, path_nodes, noise.scales(steps))[0], x_hint, evidence)
        )
    best = max(found, key=lambda item: item[0])
    steps = _likeliest(model, best[2], path_nodes, noise, steps)
    kept = [item for item in found if item[0] > best[0] - _NEGLIGIBLE]
    points, log_weights = _scale_points(model, best[2], path_nodes, noise, steps)
    parts = []
    for _, x_hint, evidence in kept:
        for point, log_weight in zip(points, log_weights, strict=True):
            log_evidence, step, information = integrate_gaussian(
                model, evidence, path_nodes, noise.scales(point)
            )
            parts.append((log_evidence + log_weight, x_hint + step, information))
    logs = np.array([part[0] for part in parts])
    weights = np.exp(logs - np.logaddexp.reduce(logs))
    return Posterior(
        model=model,
        mean=np.sum([w * part[1] for w, part in zip(weights, parts, strict=True)], axis=0),
        draws=_drawn(weights, parts),
        log_evidence=float(np.logaddexp.reduce(logs)),
        scales=noise.scales(steps),
    )


def fit_path(
    models: list[JointModel], path_nodes: PathNodes, noise: NoisePrior
) -> tuple[float, Array, JointModel, Array]:
    """The path alone: log evidence, sizes of the flaws (as steps), the model about its axis and the unknowns."""
    path = models[0].path
    first = noise.first_steps(path.points_world, models[0].turns_world)
    scales = noise.scales(first)
    found = []
    for model in models:
        x = model.first()
        for _ in range(2):
            model, x = model.about(solve(model, path_nodes, scales, None, x))
        found.append(
            (integrate_gaussian(model, linearize_model(model, None, x), path_nodes, scales)[0], model, x)
        )
    _, model, x = max(found, key=lambda item: item[0])
    evidence = linearize_model(model, None, x)
    steps = _likeliest(model, evidence, path_nodes, noise, first)
    return _log_posterior(model, evidence, path_nodes, noise, steps), steps, model, x


def _log_posterior(
    model: JointModel, evidence: LinearizedModel, path_nodes: PathNodes, noise: NoisePrior, steps: Array
) -> float:
    """Of the sizes of the flaws, the unknowns integrated out."""
    return integrate_gaussian(model, evidence, path_nodes, noise.scales(steps))[0] - 0.5 * float(
        steps @ steps
    )


def _likeliest(
    model: JointModel, evidence: LinearizedModel, path_nodes: PathNodes, noise: NoisePrior, first: Array
) -> Array:
    result = minimize(
        lambda steps: -_log_posterior(model, evidence, path_nodes, noise, steps),
        first,
        method="L-BFGS-B",
        bounds=[STEP_LIMITS] * len(first),
        options={"maxiter": 15, "ftol": 1e-5},
    )
    return np.asarray(result.x, np.float64)


def _scale_points(
    model: JointModel, evidence: LinearizedModel, path_nodes: PathNodes, noise: NoisePrior, center: Array
) -> tuple[Array, Array]:
    """Even points (N, 7) over the sizes' posterior, with log weights (N,) that make them its integral."""
    size = len(center)

    def value(steps: Array) -> float:
        return _log_posterior(model, evidence, path_nodes, noise, steps)

    h, middle = 0.3, value(center)
    unit = h * np.eye(size)
    ahead = [value(center + unit[i]) for i in range(size)]
    behind = [value(center - unit[i]) for i in range(size)]
    curvature = np.array([(2 * middle - ahead[i] - behind[i]) / h**2 for i in range(size)])
    sds = 1.1 / np.sqrt(np.clip(curvature, 0.5, None))
    normal = _normal_points(_SCALE_POINTS, size)
    points = np.clip(center + normal * sds, *STEP_LIMITS)
    own = -0.5 * (normal**2).sum(1) - np.log(sds).sum() - size / 2 * np.log(2 * np.pi)
    prior = -0.5 * (points**2).sum(1) - size / 2 * np.log(2 * np.pi)
    return points, prior - own - np.log(len(points))


def _drawn(weights: Array, parts: list[tuple[float, Array, Array]]) -> Array:
    """Samples (S, P) of the mixture, evenly taken."""
    places = (np.arange(_DRAWS) + 0.5) / _DRAWS
    chosen = np.minimum(np.searchsorted(np.cumsum(weights), places), len(parts) - 1)
    normal = _normal_points(_DRAWS, len(parts[0][1]))
    draws = np.empty_like(normal)
    for part in np.unique(chosen):
        L = np.linalg.cholesky(parts[part][2])
        mine = chosen == part
        draws[mine] = parts[part][1] + solve_triangular(L.T, normal[mine].T).T
    return draws


def _normal_points(count: int, size: int) -> Array:
    """Low-discrepancy points (count, size) of the standard normal distribution, always the same."""
    even = qmc.Halton(size, scramble=False).random(count + 1)[1:]
    return np.asarray(ndtri(even), np.float64)
