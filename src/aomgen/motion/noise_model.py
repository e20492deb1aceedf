"""How a hand errs while it moves a part: noise of the log, slow slip, a handle that turns in the fingers.

Slip is smooth: it grows steadily and bends a little, so neither many samples nor small residuals make
it small. It enters as a Gaussian process along the path whose size each demonstration shows by its
bends, starting from what grasps usually do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from aomgen.core.joint import JointType
from aomgen.core.values import Array, freeze_arrays

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


@dataclass(frozen=True, slots=True, kw_only=True)
class NoisePrior:
    """Usual sizes of the flaws and how much they differ between demonstrations.

    From simulated contact with doors and drawers and from joint logs with 0.5 mrad of noise, averaged over a stretch
    of the path.

    Attributes:
        medians: In the order of `SCALES`.
        spreads: Standard deviation of the natural logarithm of each.
    """

    medians: tuple[float, ...] = (0.00015, 0.0005, 0.004, 0.006, 0.016, 0.015, 0.0015)
    spreads: tuple[float, ...] = (0.7, 0.7, 1.0, 1.8, 1.4, 1.2, 1.2)

    def scales(self, steps: Array) -> Array:
        """Sizes (7,) that lie `steps` (7,) standard deviations from their medians."""
        return np.array(self.medians) * np.exp(np.array(self.spreads) * steps)

    def loosened(self) -> "NoisePrior":
        """Usual flaws of a path on which the hand only pushes or hooks: it slides across the motion."""
        medians, spreads = (
            dict(zip(SCALES, self.medians, strict=True)),
            dict(zip(SCALES, self.spreads, strict=True)),
        )
        medians |= {"face": _LOOSE_RATE / 4, "bar": _LOOSE_RATE, "straight": _LOOSE_RATE}
        spreads |= {"bar": _LOOSE_SPREAD, "straight": _LOOSE_SPREAD}
        return NoisePrior(medians=tuple(medians.values()), spreads=tuple(spreads.values()))


@dataclass(frozen=True, slots=True, kw_only=True)
class PathNoise:
    """Covariances of what a path's nodes may err by.

    Attributes:
        prior: Usual sizes of the flaws.
        travel_m: Travel since the first node (K,), [m].
        inflation: Factor (K,) on the unsteadiness of each node, 1 where nothing is wrong.
        waves: Covariance (K, K) of an uneven course of length one.
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

    def loosened(self, nodes: slice) -> "PathNoise":
        """The same with some nodes that may lie anywhere near."""
        inflation = self.inflation.copy()
        inflation[nodes] = _INFLATION
        return replace(self, inflation=inflation)

    def covariance(self, kind: str, scales: Array, firmness: float) -> Array:
        """Covariance (K, K) of a kind of residual: "face", "bar", "straight" [m], "tilt", "pivot" [rad].

        Args:
            kind: Which one.
            scales: Sizes of the flaws (7,).
            firmness: Square of the cosine between the "straight" direction and that in which the fingers
                close; by the rest they give way as along the bar.
        """
        sizes = dict(zip(SCALES, scales, strict=True)) | {"straight": compute_held_rate(scales, firmness)}
        steady, uneven = (0.0, sizes[kind]) if kind == "pivot" else (sizes[kind], BEND_SHARE * sizes[kind])
        white = sizes["turn" if kind in ("tilt", "pivot") else "place"]
        s = self.travel_m
        course = steady**2 * np.outer(s, s) + (uneven * s[-1]) ** 2 * self.waves
        return course + np.diag((white * self.inflation) ** 2)

    def whiten(self, kinds: Sequence[str], steps: Array, firmness: float) -> tuple[Array, float]:
        """Matrices (C, K, K) that make residuals of kinds white, and the sum of their log determinants."""
        scales = self.prior.scales(steps)
        factors = np.linalg.cholesky([self.covariance(kind, scales, firmness) for kind in kinds])
        logs = np.log(np.diagonal(factors, axis1=1, axis2=2))
        return np.asarray(np.linalg.inv(factors), np.float64), 2 * float(logs.sum())


def compute_held_rate(scales: Array, firmness: float) -> float:
    """Slip per travel [m/m] of a straight path in the direction across it that the fingers hold best.

    Args:
        scales: Sizes of the flaws (7,).
        firmness: See `PathNoise.covariance`.
    """
    straight, bar = scales[SCALES.index("straight")], scales[SCALES.index("bar")]
    return float(np.sqrt(firmness * straight**2 + (1 - firmness) * bar**2))


def compute_give_rate(joint_type: JointType, scales: Array, closing: float) -> float:
    """Slip per travel [m/m] along the way of the part, which no path of a hand shows.

    Args:
        joint_type: Of the part.
        scales: Sizes of the flaws (7,).
        closing: Cosine between the way and the direction in which the fingers close.

    Source: a sliding contact gives way against the whole of the force on it (Coulomb), so that a hand
    that slides along the bar also loses a share of that along its pull.
    """
    along_pads = np.sqrt(max(1 - closing**2, 0.0))
    return float(np.hypot(_GIVE_RATES[joint_type], _LOST_SHARE * along_pads * scales[SCALES.index("bar")]))
