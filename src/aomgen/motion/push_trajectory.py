"""The course of a part that is pushed or hooked: a hand that does not hold it takes it forward only.

Before the hand meets the part and after it lets go, it moves freely. In between, the part is as far as the
hand ever pushed it; the picture tells where on the hand's way that begins and ends.
"""

from dataclasses import dataclass

import numpy as np

from aomgen.core.values import Array, freeze
from aomgen.motion.joint_value import ValueTrajectory
from aomgen.motion.keyframes import Departures
from aomgen.motion.onset import STILL_M, Detectability, GripperPath, detect_offset, detect_onset

# A hand leaves for good when it goes aside, farther than along the part's way, by this much within this time.
_ASIDE_M, _ASIDE_S = 0.004, 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchObservation:
    """What the video shows of the two ends.

    Attributes:
        times_s: Times of the frames of the touch (T,), [s].
        seen: The part's departures in them.
        sight: What the picture can tell.
    """

    times_s: Array
    seen: Departures
    sight: Detectability

    def __post_init__(self) -> None:
        freeze(self, "times_s", self.times_s, (len(self.seen.left),))


def follow_pushed_part(
    times_s: Array,
    values: Array,
    hand: tuple[Array, Array],
    seen_s: tuple[float, float],
    leave: float,
    picture: TouchObservation,
) -> ValueTrajectory:
    """Follow a part by the value that the hand's way would give it.

    Args:
        times_s: Dense times of the touch (T,), [s].
        values: The joint value if the hand held the part all the time (T,), smooth, growing in the
            demonstrated direction.
        hand: The touching point (T, 3) in the world, and as it would be seen from the part if it held it, [m].
        seen_s: A first guess of start and end, [s]; the hand pushes at their middle.
        leave: Change of the value at which a motion has begun, `LEAVE_RAD` or `LEAVE_M`.
        picture: Of the touch.
    """
    middle = int(np.argmin(np.abs(times_s - sum(seen_s) / 2)))
    gone = middle + _left(times_s[middle:], *(points[middle:] for points in hand))
    farthest = _farthest(values[np.minimum(np.arange(len(values)), gone - 1)], middle)
    along = np.zeros((len(values), 3))
    along[:, 0] = farthest * (STILL_M / leave)
    way = GripperPath(times_s=times_s, points=along)
    start = detect_onset(way, picture.times_s, picture.seen.left, picture.sight, held=False)
    end = detect_offset(way, picture.times_s, picture.seen.ahead, picture.sight, held=False)
    interval = (min(start.time_s, end.time_s), max(start.time_s, end.time_s))
    first, last = np.interp(interval, times_s, farthest)
    return ValueTrajectory(
        times_s=times_s, values=farthest, interval=interval, levels=(first - leave, last + leave)
    )


def _left(times_s: Array, points_world: Array, points_part: Array) -> int:
    """Index in (T,), at least 1, from which on the hand has left its part sideways; T when it never does."""
    later = np.searchsorted(times_s, times_s + _ASIDE_S).clip(max=len(times_s) - 1)
    aside = np.linalg.norm(points_part[later] - points_part, axis=1)
    moved = np.linalg.norm(points_world[later] - points_world, axis=1)
    # Of a way and what of it goes aside: more than half of its square.
    off = (aside > _ASIDE_M) & (2 * aside**2 > moved**2)
    return max(1, int(np.argmax(off))) if off.any() else len(times_s)


def _farthest(values: Array, middle: int) -> Array:
    """Values (T,) without what the hand moves backwards: before it comes to the part, and when it leaves it."""
    return np.concatenate(
        [np.minimum.accumulate(values[: middle + 1][::-1])[::-1], np.maximum.accumulate(values[middle:])[1:]]
    )
