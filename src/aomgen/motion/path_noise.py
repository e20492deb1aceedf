"""Noise of a gripper's path while it moves a part: slow slip along the path, and unsteadiness of every node.

Slip grows steadily and bends a little, so neither many samples nor small residuals reduce it: it is a Gaussian process
along the path, whose scale each demonstration shows by its bends.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from aomgen.core.joint import JointType
from aomgen.core.values import Array, freeze_arrays

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
# Noise scales: position [m] and rotation [rad] of the gripper from segment to segment; slip along the part's
# face, and along the handle's bar or the fingers' pads, per travel [m/m]; rotation of the gripper across the
# joint's axis, and uneven rotation of the handle in the fingers, per travel [rad/m]; slip in the closing
# direction of the fingers, per travel [m/m].
SCALES = ("place", "turn", "face", "bar", "tilt", "pivot", "straight")


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

    def separate(self, kinds: Sequence[str], closing_alignment: float) -> "IndependentErrors":
        """Separate the errors of residuals "face", "bar", "straight" [m], "tilt" or "pivot" [rad].

        `closing_alignment` is the squared cosine between the "straight" direction and the closing direction
        of the fingers; for the remaining share the grasp yields as along the bar.
        """
        s = self.travel_m
        uneven = s[-1] ** 2 * self.waves
        courses = np.stack([np.outer(s, s) + BEND_SHARE**2 * uneven, uneven])
        # A covariance is a course and white noise, both with a factor: one basis separates all of them.
        powers, vectors = np.linalg.eigh(courses / np.outer(self.inflation, self.inflation))
        rows = [int(kind == "pivot") for kind in kinds]
        course, white = np.zeros((2, len(kinds), len(SCALES)))
        for row, kind in enumerate(kinds):
            shares = {"straight": closing_alignment, "bar": 1 - closing_alignment}
            for name, share in shares.items() if kind == "straight" else [(kind, 1.0)]:
                course[row, SCALES.index(name)] = share
            white[row, SCALES.index("turn" if kind in ("tilt", "pivot") else "place")] = 1.0
        return IndependentErrors(
            prior=self.prior,
            rotations=(vectors.swapaxes(1, 2) / self.inflation)[rows],
            powers=np.maximum(powers, 0.0)[rows, :, None] * course[:, None] + white[:, None],
            log_volume=2 * len(kinds) * float(np.log(self.inflation).sum()),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class IndependentErrors:
    """A basis in which the errors of a path's nodes are independent for all noise scales.

    Attributes:
        rotations: Matrices that turn the residuals of each kind into independent ones.
        powers: Their variances per squared noise scale.
        log_volume: Sum of the log determinants of the covariances where all variances are one.
    """

    prior: NoisePrior
    rotations: Annotated[Array, "C K K"]
    powers: Annotated[Array, "C K 7"]
    log_volume: float

    __post_init__ = freeze_arrays

    def variances(self, steps: Array) -> Array:
        """Compute the share (C, K, 7) of each noise scale in the variances, for scales as in `NoisePrior`."""
        return self.powers * self.prior.scales(steps) ** 2


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
