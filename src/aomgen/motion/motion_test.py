"""Whether the part moved at all: the picture's change and the hand's pull weighed together."""

from dataclasses import dataclass

import numpy as np

from aomgen.errors import NoMotionError
from aomgen.motion.onset import STILL_M
from aomgen.motion.rendered_motion_test import FollowingEstimate

# Fingers that stay farther away touch nothing, whatever the alignment's error, [m].
NEAR_M = 0.10
# A standing part's picture changes all the same, by shadows of the arm: mean share.
_SHADOWS = 0.05
# Change alone never convinces beyond these odds, e**3 = 20 to 1; shadows come in all sizes.
_MOST = 3.0
# A part that moves follows the hand's drawing by this share, and so widely; a standing one seems to
# follow by chance, as shadows fall: standard deviation.
_FOLLOWS, _FOLLOWS_SD, _CHANCE_SD = 0.7, 0.35, 0.12


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionEvidence:
    """What speaks for and against a motion.

    Attributes:
        changed: Largest share of the part's picture that shows neither its first nor its last place.
        following: How far the part follows the hand.
        nearest_m: Smallest distance of the fingers to the part, [m].
        travel_m: Way of the hand during the touch, [m].
    """

    changed: float
    following: FollowingEstimate
    nearest_m: float
    travel_m: float

    @property
    def log_likelihood_ratio(self) -> float:
        """Natural logarithm of how many times more likely a motion is than none."""
        # Densities: 1 over 0..1 if it moved, exponential with mean _SHADOWS if not.
        change = float(np.clip(self.changed / _SHADOWS + np.log(_SHADOWS), -_MOST, _MOST))
        share, noise = self.following.share, self.following.sd
        if not (np.isfinite(noise) and self.travel_m > STILL_M):
            return change
        moved, stood = np.hypot(_FOLLOWS_SD, noise), np.hypot(_CHANCE_SD, noise)
        pull = (share / stood) ** 2 / 2 - ((share - _FOLLOWS) / moved) ** 2 / 2 + np.log(stood / moved)
        # More than the part of the whole way is no worse a sign than the whole way.
        return change + float(np.clip(pull, -2 * _MOST, 2 * _MOST))

    def check(self) -> None:
        """Refuse a demonstration in which the part stays where it is.

        Raises:
            NoMotionError: The hand never comes near, or the part does not move.
        """
        if not self.nearest_m <= NEAR_M:
            raise NoMotionError(
                "demonstration video",
                f"the hand never touches the part: it stays {100 * self.nearest_m:.0f} cm away, "
                f"limit {100 * NEAR_M:.0f} cm",
                "check the 'moving' prompts, and that video and joint log show the same demonstration",
            )
        if self.log_likelihood_ratio > 0:
            return
        pulled = f"the hand moves {1e3 * self.travel_m:.0f} mm while it is near the part"
        if np.isfinite(self.following.sd):
            pulled += f", the part follows by {100 * max(self.following.share, 0.0):.0f} % of that"
        raise NoMotionError(
            "demonstration video",
            f"the part does not move: {pulled}, and {100 * self.changed:.0f} % of its picture changes in between "
            f"(odds of a motion {np.exp(self.log_likelihood_ratio):.2g}, need 1)",
            "check that the video shows the whole motion, that the part is not locked, and the 'moving' prompts",
        )
