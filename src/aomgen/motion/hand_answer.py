"""What the hand's path says about the motion, before the film is asked."""

from dataclasses import dataclass

from aomgen.core.joint import Joint
from aomgen.core.values import Array, freeze


@dataclass(frozen=True, slots=True, kw_only=True)
class HandAnswer:
    """What the hand's path says.

    Attributes:
        joint: Axis and origin, world frame; value 0 is the scanned state.
        held_world: Held point when the motion begins (3,), [m].
        axis_sd_rad, origin_sd_m: Root of the summed variances of the direction, and of the axis line
            where it passes the held point, [rad], [m].
        interval: First and last moment of the motion, [s].
        times_s: Video frame times (T,).
        thetas: Values (T,), [rad] or [m].
        theta_sd: Their standard deviation (T,).
    """

    joint: Joint
    held_world: Array
    axis_sd_rad: float
    origin_sd_m: float
    interval: tuple[float, float]
    times_s: Array
    thetas: Array
    theta_sd: Array

    def __post_init__(self) -> None:
        freeze(self, "held_world", self.held_world, (3,))
        for name in ("times_s", "thetas", "theta_sd"):
            freeze(self, name, getattr(self, name), (len(self.times_s),))
