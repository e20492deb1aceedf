"""The posterior of a joint model, given the errors of a gripper that moves a part.

The errors are noise of the log, slow slip, and rotation of the handle in the fingers. Slip grows steadily and
bends a little, so neither many samples nor small residuals reduce it: it is a Gaussian process along the
path, whose scale each demonstration shows by its bends. Every axis prior of the shape combined with every
choice of noise scales gives a Gaussian with an evidence; their mixture is the posterior, and the evidence of
a joint type is their sum.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, cast

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares, minimize

from aomgen.core.joint import JointType
from aomgen.core.quadrature import normal_points
from aomgen.core.values import Array, freeze_arrays
from aomgen.motion.joint_models import Prismatic, Revolute
from aomgen.motion.part_shape import UNIFORM_PRIOR, AxisPrior

# A slow slip curve bends at its middle by 0.15 to 0.3 of its end value; finer waves decrease with the square
# of their number (doors opened by contact).
BEND_SHARE = 0.22
# Waves along a path; the next one would have 1/36 of the first one's amplitude.
_WAVES = 5
# Grasps yield along the motion by this per travel, more where a handle rolls between the fingers (simulated
# contact with 27 doors and lids, 18 drawers and sliding panels), [m/m].
_GIVE_RATES = {"prismatic": 0.002, "revolute": 0.004}
# Grippers that slide along the bar of a drawer lose 0.05 to 0.23 of that along the pull (10 drawers).
_LOST_SHARE = 0.16
# Unsteadiness of a node at which the gripper may not have held the part, relative to the others.
_INFLATION = 100.0
# A gripper that grips nothing slides freely along the part, by a centimeter or two in a motion of 5 to
# 30 cm, [m/m]. It may slide evenly, so that the bends of its path do not show the slip: hardly any spread.
_LOOSE_RATE, _LOOSE_SPREAD = 0.06, 0.1
# Noise scales are searched within this many standard deviations of their medians.
STEP_LIMITS = (-3.0, 5.0)
# Noise scales: position [m] and rotation [rad] of the gripper from segment to segment; slip along the part's
# face, and along the handle's bar or the fingers' pads, per travel [m/m]; rotation of the gripper across the
# joint's axis, and uneven rotation of the handle in the fingers, per travel [rad/m]; slip in the closing
# direction of the fingers, per travel [m/m].
SCALES = ("place", "turn", "face", "bar", "tilt", "pivot", "straight")
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
class NoisePrior:
    """Medians of the noise scales in the order of `SCALES`, and standard deviations of their logarithms.

    They come from simulated contact with doors and drawers and from joint logs with 0.5 mrad of noise,
    averaged over a segment of the path.
    """

    medians: tuple[float, ...] = (0.00015, 0.0005, 0.004, 0.006, 0.016, 0.015, 0.0015)
    spreads: tuple[float, ...] = (0.7, 0.7, 1.0, 1.8, 1.4, 1.2, 1.2)

    def scales(self, steps: Array) -> Array:
        """Compute the noise scales (7,) that are `steps` (7,) standard deviations from their medians."""
        return np.array(self.medians) * np.exp(np.array(self.spreads) * steps)

    def loosen(self) -> "NoisePrior":
        """Return the prior for a gripper that only pushes or hooks: it slides across the motion."""
        medians, spreads = (dict(zip(SCALES, row, strict=True)) for row in (self.medians, self.spreads))
        medians |= {"face": _LOOSE_RATE / 4, "bar": _LOOSE_RATE, "straight": _LOOSE_RATE}
        spreads |= {"bar": _LOOSE_SPREAD, "straight": _LOOSE_SPREAD}
        return NoisePrior(medians=tuple(medians.values()), spreads=tuple(spreads.values()))


@dataclass(frozen=True, slots=True, kw_only=True)
class PathNoise:
    """Covariances of the errors of a path's nodes.

    Attributes:
        travel_m: Travel since the first node, [m].
        inflation: Factor on the unsteadiness of each node, 1 for a normal node.
        waves: Covariance of an uneven slip curve of length one.
    """

    prior: NoisePrior
    travel_m: Annotated[Array, "K"]
    inflation: Annotated[Array, "K"]
    waves: Annotated[Array, "K K"]

    __post_init__ = freeze_arrays

    @staticmethod
    def of(points: Array, prior: NoisePrior) -> "PathNoise":
        """Build the noise along a path of points (K, 3), with no node loosened."""
        travel = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        k = np.arange(1, _WAVES + 1)
        waves = np.sin(np.pi * np.outer(travel / travel[-1], k)) / k**2
        return PathNoise(prior=prior, travel_m=travel, inflation=np.ones(len(points)), waves=waves @ waves.T)

    def loosen(self, nodes: slice) -> "PathNoise":
        """Return the noise with some nodes whose error may be large."""
        inflation = self.inflation.copy()
        inflation[nodes] = _INFLATION
        return replace(self, inflation=inflation)

    def covariance(self, kind: str, scales: Array, closing_alignment: float) -> Array:
        """Compute the covariance (K, K) of residuals "face", "bar", "straight" [m], "tilt" or "pivot" [rad].

        `scales` are the noise scales (7,). `closing_alignment` is the squared cosine between the
        "straight" direction and the closing direction of the fingers; for the remaining share the grasp
        yields as along the bar.
        """
        sizes = dict(zip(SCALES, scales, strict=True)) | {
            "straight": compute_held_rate(scales, closing_alignment)
        }
        steady, uneven = (0.0, sizes[kind]) if kind == "pivot" else (sizes[kind], BEND_SHARE * sizes[kind])
        white = sizes["turn" if kind in ("tilt", "pivot") else "place"]
        s = self.travel_m
        course = steady**2 * np.outer(s, s) + (uneven * s[-1]) ** 2 * self.waves
        return course + np.diag((white * self.inflation) ** 2)

    def whiten(self, kinds: Sequence[str], steps: Array, closing_alignment: float) -> tuple[Array, float]:
        """Compute whitening matrices (C, K, K) of residuals by kind, and the sum of log determinants."""
        scales = self.prior.scales(steps)
        factors = np.linalg.cholesky([self.covariance(kind, scales, closing_alignment) for kind in kinds])
        logs = np.log(np.diagonal(factors, axis1=1, axis2=2))
        return np.asarray(np.linalg.inv(factors), np.float64), 2 * float(logs.sum())


def compute_held_rate(scales: Array, closing_alignment: float) -> float:
    """Compute the slip per travel [m/m] of a straight path in the lateral direction that is held best."""
    straight, bar = scales[SCALES.index("straight")], scales[SCALES.index("bar")]
    return float(np.sqrt(closing_alignment * straight**2 + (1 - closing_alignment) * bar**2))


def compute_give_rate(joint_type: JointType, scales: Array, closing: float) -> float:
    """Compute the slip per travel [m/m] along the part's path, which the gripper's path does not show.

    `closing`: Cosine between the path and the direction in which the fingers close.

    Source: a sliding contact yields against the total force on it (Coulomb), so that a gripper
    that slides along the bar also loses a share of that along its pull.
    """
    along_pads = np.sqrt(max(1 - closing**2, 0.0))
    return float(np.hypot(_GIVE_RATES[joint_type], _LOST_SHARE * along_pads * scales[SCALES.index("bar")]))


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
        data: Residuals (C, K) and their Jacobian (C, K, P).
        prior, log_prior: Residuals (Q,) in standard deviations, their Jacobian (Q, P), and their normalization.
    """

    model: Revolute | Prismatic
    noise: PathNoise
    x: Array
    data: tuple[Array, Array]
    prior: tuple[Array, Array]
    log_prior: float

    @staticmethod
    def of(model: Revolute | Prismatic, noise: PathNoise, hint: AxisPrior, x: Array) -> "LinearizedModel":
        """Linearize by central differences."""
        steps = model.steps * 1e-3
        around = np.concatenate([x[None], x + np.diag(steps), x - np.diag(steps)])

        def differences(rows: Array) -> tuple[Array, Array]:
            ahead, behind = np.split(rows[1:], 2)
            return rows[0], np.moveaxis(ahead - behind, 0, -1) / (2 * steps)

        place = 0.0 if len(hint.across) else model.log_diffuse_position_prior(x)
        return LinearizedModel(
            model=model,
            noise=noise,
            x=x,
            data=differences(model.data(around)),
            prior=differences(_prior(model, hint, around)),
            log_prior=hint.log_density + place + model.log_prior_norm,
        )

    def gaussian(self, steps: Array) -> tuple[float, Array, Array]:
        """Compute log evidence, mean (P,) and information (P, P) of the unknowns for given noise scales."""
        whiten, log_det = self.noise.whiten(self.model.kinds, steps, self.model.closing_alignment)
        r = np.append(whiten @ self.data[0][..., None], self.prior[0])
        J = np.concatenate([(whiten @ self.data[1]).reshape(-1, len(self.x)), self.prior[1]])
        information, gradient = J.T @ J, J.T @ r
        step = -np.linalg.solve(information, gradient)
        cost = r @ r + gradient @ step + np.linalg.slogdet(information)[1] + log_det
        free = len(self.x) * np.log(2 * np.pi)
        return float(self.log_prior - 0.5 * (cost - free)), self.x + step, information

    def log_posterior(self, steps: Array) -> float:
        """Compute the log posterior of the noise scales, with the unknowns integrated out."""
        return self.gaussian(steps)[0] - 0.5 * float(steps @ steps)

    def likeliest(self, first: Array) -> Array:
        """Find the most likely noise scales (7,), starting from given ones."""
        limits = {"bounds": [STEP_LIMITS] * len(first), "options": {"maxiter": 15, "ftol": 1e-5}}
        result = minimize(lambda steps: -self.log_posterior(steps), first, method="L-BFGS-B", **limits)
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
    whiten = noise.whiten(model.kinds, steps, model.closing_alignment)[0]

    def residuals(x: Array) -> Array:
        return np.append(whiten @ model.data(x)[..., None], _prior(model, hint, x))

    def slopes(x: Array) -> Array:
        here = LinearizedModel.of(model, noise, hint, x)
        return np.concatenate([(whiten @ here.data[1]).reshape(-1, len(x)), here.prior[1]])

    limits = {"ftol": _TOLERANCE, "max_nfev": _MAX_STEPS}
    # The type stubs of scipy do not accept a function as Jacobian.
    result = least_squares(residuals, first, cast(Any, slopes), method="lm", x_scale=model.steps, **limits)
    return np.asarray(result.x, np.float64)


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
