"""The posterior of a joint model, given how a hand errs while it moves a part.

It errs by noise of the log, slow slip, a handle that turns in the fingers. Slip grows steadily and bends a little, so
neither many samples nor small residuals make it small: it is a Gaussian process along the path, whose size each
demonstration shows by its bends. Every hint of the shape times every size of these flaws is a Gaussian with an
evidence; together they are the answer, and the evidence of a joint type is their sum.
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

# A slow course bends at its middle by 0.15 to 0.3 of its end value, finer waves are smaller as their
# number squared (doors opened by contact).
BEND_SHARE = 0.22
# Waves along a path; the next one would have 1/36 of the first one's amplitude.
_WAVES = 5
# Grasps give way along the motion by this per travel, more where a handle rolls between the fingers (simulated
# contact with 27 doors and lids, 18 drawers and sliding panels), [m/m].
_GIVE_RATES = {"prismatic": 0.002, "revolute": 0.004}
# Hands that slide along the bar of a drawer lose 0.05 to 0.23 of that along the pull (10 drawers).
_LOST_SHARE = 0.16
# Unsteadiness of a node at which the hand may not have held the part, over that of the others.
_INFLATION = 100.0
# A hand that grips nothing slides along the part as it likes, by a centimeter or two in a motion of 5 to
# 30 cm, [m/m]. It may slide evenly, so that its path's bends do not tell how much: hardly any spread.
_LOOSE_RATE, _LOOSE_SPREAD = 0.06, 0.1
# Sizes are looked for between so many standard deviations from their medians.
STEP_LIMITS = (-3.0, 5.0)
# What errs: place [m] and turn [rad] of the hand from stretch to stretch; slip along the part's face, and along the
# handle's bar or the fingers' pads, per travel [m/m]; turn of the hand across the joint's axis, and uneven turn of the
# handle in the fingers, per travel [rad/m]; slip in the direction in which the fingers close, per travel [m/m].
SCALES = ("place", "turn", "face", "bar", "tilt", "pivot", "straight")
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
class NoisePrior:
    """Usual sizes of the flaws in the order of `SCALES`, and standard deviations of their natural logarithms.

    From simulated contact with doors and drawers and from joint logs with 0.5 mrad of noise, averaged over a stretch
    of the path.
    """

    medians: tuple[float, ...] = (0.00015, 0.0005, 0.004, 0.006, 0.016, 0.015, 0.0015)
    spreads: tuple[float, ...] = (0.7, 0.7, 1.0, 1.8, 1.4, 1.2, 1.2)

    def scales(self, steps: Array) -> Array:
        """Sizes (7,) that lie `steps` (7,) standard deviations from their medians."""
        return np.array(self.medians) * np.exp(np.array(self.spreads) * steps)

    def loosen(self) -> "NoisePrior":
        """Usual flaws of a path on which the hand only pushes or hooks: it slides across the motion."""
        medians, spreads = (dict(zip(SCALES, row, strict=True)) for row in (self.medians, self.spreads))
        medians |= {"face": _LOOSE_RATE / 4, "bar": _LOOSE_RATE, "straight": _LOOSE_RATE}
        spreads |= {"bar": _LOOSE_SPREAD, "straight": _LOOSE_SPREAD}
        return NoisePrior(medians=tuple(medians.values()), spreads=tuple(spreads.values()))


@dataclass(frozen=True, slots=True, kw_only=True)
class PathNoise:
    """Covariances of what a path's nodes may err by.

    Attributes:
        travel_m: Travel since the first node, [m].
        inflation: Factor on the unsteadiness of each node, 1 where nothing is wrong.
        waves: Covariance of an uneven course of length one.
    """

    prior: NoisePrior
    travel_m: Annotated[Array, "K"]
    inflation: Annotated[Array, "K"]
    waves: Annotated[Array, "K K"]

    __post_init__ = freeze_arrays

    @staticmethod
    def of(points: Array, prior: NoisePrior) -> "PathNoise":
        """Along a path of points (K, 3), none of them loosened."""
        travel = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        k = np.arange(1, _WAVES + 1)
        waves = np.sin(np.pi * np.outer(travel / travel[-1], k)) / k**2
        return PathNoise(prior=prior, travel_m=travel, inflation=np.ones(len(points)), waves=waves @ waves.T)

    def loosen(self, nodes: slice) -> "PathNoise":
        """The same with some nodes that may lie anywhere near."""
        inflation = self.inflation.copy()
        inflation[nodes] = _INFLATION
        return replace(self, inflation=inflation)

    def covariance(self, kind: str, scales: Array, closing_alignment: float) -> Array:
        """Covariance (K, K) of a kind of residual: "face", "bar", "straight" [m], "tilt", "pivot" [rad].

        By sizes of the flaws (7,), and the square of the cosine between the "straight" direction and that in which
        the fingers close; by the rest they give way as along the bar.
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
        """Matrices (C, K, K) that make residuals of kinds white, and the sum of their log determinants."""
        scales = self.prior.scales(steps)
        factors = np.linalg.cholesky([self.covariance(kind, scales, closing_alignment) for kind in kinds])
        logs = np.log(np.diagonal(factors, axis1=1, axis2=2))
        return np.asarray(np.linalg.inv(factors), np.float64), 2 * float(logs.sum())


def compute_held_rate(scales: Array, closing_alignment: float) -> float:
    """Slip per travel [m/m] of a straight path in the direction across it that is held best, see `PathNoise.covariance`."""
    straight, bar = scales[SCALES.index("straight")], scales[SCALES.index("bar")]
    return float(np.sqrt(closing_alignment * straight**2 + (1 - closing_alignment) * bar**2))


def compute_give_rate(joint_type: JointType, scales: Array, closing: float) -> float:
    """Slip per travel [m/m] along the way of the part, which no path of a hand shows.

    `closing`: Cosine between the way and the direction in which the fingers close.

    Source: a sliding contact gives way against the whole of the force on it (Coulomb), so that a hand
    that slides along the bar also loses a share of that along its pull.
    """
    along_pads = np.sqrt(max(1 - closing**2, 0.0))
    return float(np.hypot(_GIVE_RATES[joint_type], _LOST_SHARE * along_pads * scales[SCALES.index("bar")]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """What is known of one joint type's unknowns.

    Attributes:
        draws: Samples of the unknowns, equally likely.
        log_evidence: Of the type, up to a constant that all types share.
        scales: Sizes of the flaws at their likeliest.
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
        """By central differences."""
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
        """Log evidence, mean (P,) and information (P, P) of the unknowns at given sizes of the flaws."""
        whiten, log_det = self.noise.whiten(self.model.kinds, steps, self.model.closing_alignment)
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
        limits = {"bounds": [STEP_LIMITS] * len(first), "options": {"maxiter": 15, "ftol": 1e-5}}
        result = minimize(lambda steps: -self.log_posterior(steps), first, method="L-BFGS-B", **limits)
        return np.asarray(result.x, np.float64)

    def scale_points(self, center: Array) -> tuple[Array, Array]:
        """Even points (N, 7) over the sizes' posterior, with log weights (N,) that make them its integral."""
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
    """What is known of one joint type, by its models about different first axes; none of the shape's hints may hold."""
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
    """The path alone, by the model whose first axis fits best, and the likeliest sizes of its flaws (7,)."""
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
    """Unknowns (P,) that fit best at given sizes of the flaws."""
    whiten = noise.whiten(model.kinds, steps, model.closing_alignment)[0]

    def residuals(x: Array) -> Array:
        return np.append(whiten @ model.data(x)[..., None], _prior(model, hint, x))

    def slopes(x: Array) -> Array:
        here = LinearizedModel.of(model, noise, hint, x)
        return np.concatenate([(whiten @ here.data[1]).reshape(-1, len(x)), here.prior[1]])

    limits = {"ftol": _TOLERANCE, "max_nfev": _MAX_STEPS}
    # Its type stubs know no function for a Jacobian.
    result = least_squares(residuals, first, cast(Any, slopes), method="lm", x_scale=model.steps, **limits)
    return np.asarray(result.x, np.float64)


def _prior(model: Revolute | Prismatic, hint: AxisPrior, x: Array) -> Array:
    return np.concatenate([model.prior_residuals(x), hint.residuals(*model.lines(x))], axis=-1)


def _draw(weights: Array, parts: Sequence[tuple[float, Array, Array]]) -> Array:
    """Samples (S, P) of the mixture of Gaussians (log evidence, mean, information), evenly taken."""
    places = (np.arange(_DRAWS) + 0.5) / _DRAWS
    chosen = np.minimum(np.searchsorted(np.cumsum(weights), places), len(parts) - 1)
    draws = normal_points(_DRAWS, len(parts[0][1]))
    for part in np.unique(chosen):
        _, mean, information = parts[part]
        L, mine = np.linalg.cholesky(information), chosen == part
        draws[mine] = mean + solve_triangular(L.T, draws[mine].T).T
    return draws
