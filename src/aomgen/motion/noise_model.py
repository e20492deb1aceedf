"""How a hand errs while it moves a part: noise of the log, slow slip, a handle that turns in the fingers.

Slip is smooth: it grows steadily and bends a little, so neither many samples nor small residuals make
it small. It enters as a Gaussian process along the path whose size each demonstration shows by its
bends, starting from what grasps usually do.
"""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.core.joint import JointType
from aomgen.core.robust import robust_sd
from aomgen.core.values import Array, freeze

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
# Sizes are looked for between so many standard deviations from their medians.
STEP_LIMITS = (-3.0, 5.0)
# Names of the sizes, in the order of `NoiseScales.logs`.
SCALES = ("place", "turn", "face", "bar", "tilt", "pivot", "straight")


@dataclass(frozen=True, slots=True, kw_only=True)
class NoisePrior:
    """Usual sizes of the flaws and how much they differ between demonstrations (natural logarithm).

    Medians come from simulated contact with doors and drawers and from joint logs with 0.5 mrad of
    noise, averaged over a stretch of the path.

    Attributes:
        place_m, turn_rad: Unsteadiness of hand pose from stretch to stretch.
        face_rate, bar_rate: Slip along the part's face, and along the handle's bar or the fingers' pads
            on a straight path, per travel, [m/m].
        tilt_rate: Turn of the hand across the joint's axis per travel, [rad/m].
        pivot_rate: Uneven turn of the handle in the fingers per travel, [rad/m].
        straight_rate: Slip in the direction in which the fingers close per travel, [m/m].
        spreads: Standard deviation of the logarithm of each, in this order.
    """

    place_m: float = 0.00015
    turn_rad: float = 0.0005
    face_rate: float = 0.004
    bar_rate: float = 0.006
    tilt_rate: float = 0.016
    pivot_rate: float = 0.015
    straight_rate: float = 0.0015
    spreads: tuple[float, ...] = (0.7, 0.7, 1.0, 1.8, 1.4, 1.2, 1.2)

    @property
    def medians(self) -> Array:
        """In the order of `SCALES` (7,)."""
        rates = (self.face_rate, self.bar_rate, self.tilt_rate, self.pivot_rate, self.straight_rate)
        return np.array([self.place_m, self.turn_rad, *rates])

    def first_steps(self, points: Array, turns: Array) -> Array:
        """Steps (7,) whose unsteadiness is that of a path's points and turns (K, 3); the rest is usual."""
        steps = np.zeros(len(SCALES))
        for k, rows in enumerate((points, turns)):
            rough = np.diff(rows, n=3, axis=0) if len(rows) > 5 else np.zeros((1, 3))
            # Third differences of white noise have a variance of 20.
            sd = robust_sd(rough) / np.sqrt(20.0)
            steps[k] = np.log(max(sd / self.medians[k], 1e-3)) / self.spreads[k]
        return np.clip(steps, *STEP_LIMITS)

    def scales(self, steps: Array) -> Array:
        """Sizes (7,) that lie `steps` (7,) standard deviations from their medians."""
        return self.medians * np.exp(np.array(self.spreads) * steps)


@dataclass(frozen=True, slots=True, kw_only=True)
class PathNodes:
    """Places along a path at which the hand was looked at.

    Attributes:
        travel_m: Travel since the first node (K,), [m].
        inflation: Factor (K,) on the unsteadiness of each node, 1 where nothing is wrong.
        waves: Covariance (K, K) of an uneven course of length one.
    """

    travel_m: Array
    inflation: Array
    waves: Array

    def __post_init__(self) -> None:
        count = len(self.travel_m)
        freeze(self, "travel_m", self.travel_m, (count,))
        freeze(self, "inflation", self.inflation, (count,))
        freeze(self, "waves", self.waves, (count, count))

    @staticmethod
    def of(points: Array) -> "PathNodes":
        """The nodes of a path of points (K, 3), none of them loosened."""
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        travel = np.concatenate([[0.0], np.cumsum(steps)])
        k = np.arange(1, _WAVES + 1)
        waves = np.sin(np.pi * np.outer(travel / travel[-1], k)) / k**2
        return PathNodes(travel_m=travel, inflation=np.ones(len(points)), waves=waves @ waves.T)

    def loosened(self, nodes: slice) -> "PathNodes":
        """The same course with some nodes that may lie anywhere near."""
        inflation = self.inflation.copy()
        inflation[nodes] = _INFLATION
        return replace(self, inflation=inflation)

    def steady(self, rate: float) -> Array:
        """Covariance (K, K) of a steady course with a bend, whose end has a deviation of `rate` per travel."""
        s = self.travel_m
        return rate**2 * np.outer(s, s) + self.uneven(BEND_SHARE * rate)

    def uneven(self, rate: float) -> Array:
        """Covariance (K, K) of a course without a steady part, whose middle has that deviation."""
        return (rate * self.travel_m[-1]) ** 2 * self.waves

    def white(self, sd: float) -> Array:
        """Covariance (K, K) of unsteadiness."""
        return np.diag((sd * self.inflation) ** 2)


def compute_covariances(path_nodes: PathNodes, scales: Array, firmness: float = 1.0) -> dict[str, Array]:
    """Covariance (K, K) of each kind of residual, by name.

    Args:
        path_nodes: Nodes of the path.
        scales: Sizes of the flaws (7,).
        firmness: Square of the cosine between the "straight" direction and that in which the fingers
            close; by the rest they give way as along the bar.
    """
    place, turn, face, bar, tilt, pivot, _ = scales
    white_m, white_rad = path_nodes.white(place), path_nodes.white(turn)
    return {
        "face": white_m + path_nodes.steady(face),
        "bar": white_m + path_nodes.steady(bar),
        "tilt": white_rad + path_nodes.steady(tilt),
        "straight": white_m + path_nodes.steady(compute_held_rate(scales, firmness)),
        "pivot": white_rad + path_nodes.uneven(pivot),
    }


def compute_held_rate(scales: Array, firmness: float) -> float:
    """Slip per travel [m/m] of a straight path in the direction across it that the fingers hold best.

    Args:
        scales: Sizes of the flaws (7,).
        firmness: See `compute_covariances`.
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


def factorize_covariances(
    path_nodes: PathNodes, scales: Array, firmness: float = 1.0
) -> dict[str, tuple[Array, float]]:
    """Matrix (K, K) that makes residuals white and log determinant of each covariance, by name."""
    found = {}
    for name, covariance in compute_covariances(path_nodes, scales, firmness).items():
        L = np.linalg.cholesky(covariance)
        found[name] = (np.linalg.inv(L), 2 * float(np.log(np.diag(L)).sum()))
    return found
