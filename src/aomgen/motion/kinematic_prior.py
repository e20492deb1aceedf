"""What the hand's path says about the motion, before the video is asked."""

from dataclasses import dataclass

from aomgen.core.joint import Joint
from aomgen.core.values import Array, freeze


@dataclass(frozen=True, slots=True, kw_only=True)
class KinematicPrior:
    """What the hand's path says.

    Attributes:
        joint: Axis and origin, world frame; value 0 is the scanned state.
        held_world: Held point when the motion begins (3,), [m].
        covariance: Of tilt (2) [rad] and, if revolute, shift (2) [m] of the axis in the directions
            `tangent_basis(joint.axis)`, the shift where the axis passes the held point.
        interval: First and last moment of the motion, [s].
        times_s: Video frame times (T,).
        thetas: Values (T,), [rad] or [m].
        theta_sd: Their standard deviation if the joint is as it is said (T,).
    """

    joint: Joint
    held_world: Array
    covariance: Array
    interval: tuple[float, float]
    times_s: Array
    thetas: Array
    theta_sd: Array

    def __post_init__(self) -> None:
        freeze(self, "held_world", self.held_world, (3,))
        count = 4 if self.joint.type == "revolute" else 2
        freeze(self, "covariance", self.covariance, (count, count))
        for name in ("times_s", "thetas", "theta_sd"):
            freeze(self, name, getattr(self, name), (len(self.times_s),))
