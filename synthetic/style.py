"""Style of a demonstration: travel, grasp, speed, and the recorded interval."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.motion import Direction
from aomgen.core.values import Array

GraspType = Literal["pinch", "hook", "push"]
# "moves": the part is moved. The others are videos that determine no joint: the arm moves in
# the air, touches and lets go, pulls at a locked part, or the video ends before the motion.
Outcome = Literal["moves", "nothing", "touch", "locked", "cut"]

# Travel that is drawn, [rad] or [m].
TRAVEL: Final = {"revolute": (np.deg2rad(20.0), np.deg2rad(100.0)), "prismatic": (0.05, 0.30)}
# Share of the joint's range that is used at most.
RANGE_SHARE: Final = 0.95
# The part's value has left its ends when it differs by this much, [rad] or [m].
MOVED: Final = {"revolute": np.deg2rad(0.5), "prismatic": 0.002}
# Speed with which a person lets a robot move a handle: peak, [m/s].
SPEED: Final = (0.02, 0.50)
# Length of a demonstration's video that is aimed at, [s], and share of it in which the part moves: from a blink to
# nearly all of it.
FILM_S, MOVING_SHARE = (8.0, 12.0), (0.03, 0.85)
# Mean duration that the random cut of a video removes, [s].
CUT_S: Final = 0.6
# Video before and after the motion that is always there, [s].
LEAST_BEFORE_S, LEAST_AFTER_S = 0.9, 0.5
# Largest distance that a gripper slides along a bar, [m]: less than half of a short bar; and the share of its force with
# which it holds then: with all of it the arm gives way first.
MAX_SLIP_M, SLIDING_GRIP = 0.015, (0.12, 0.25)
# Longest standstill within a motion, [s].
MAX_PAUSE_S: Final = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class DemonstrationStyle:
    """Style of one demonstration.

    Attributes:
        travel: Travel of the part, [rad] or [m], > 0.
        direction: Direction of the motion; opening mostly starts with the closed part, closing with an open one.
        start: Joint value of the scanned state, [rad] or [m].
        touch: Pinched between the fingers, pulled by closed fingers behind the bar, or pushed by them.
        outcome: Outcome of the demonstration, see `Outcome`.
        follow: Share of the part's turn that the end effector turns with; the handle pivots by the rest.
        slip_m: Distance that the gripper slides along the handle's bar while the part moves, signed, [m].
        grip: Share of its force with which the gripper closes; a firm grip hardly slides.
        motion_s: Duration of the commanded motion without the pause, [s].
        cruise: Share of the motion at constant speed; 0 is minimum jerk.
        pause_s, pause_at: Standstill after this share of the motion, [s].
        before_s, after_s: Video before and after the commanded motion, [s], up to the fractions of a
            second by which every video is cut.
    """

    travel: float
    direction: Direction = "opening"
    start: float = 0.0
    touch: GraspType = "pinch"
    outcome: Outcome = "moves"
    follow: float = 1.0
    slip_m: float = 0.0
    grip: float = 1.0
    motion_s: float = 3.0
    cruise: float = 0.0
    pause_s: float = 0.0
    pause_at: float = 0.5
    before_s: float = 4.5
    after_s: float = 2.0

    @property
    def goal(self) -> float:
        """Joint value at the end, [rad] or [m]."""
        return self.start + self.sign * self.travel

    @property
    def sign(self) -> float:
        """1 where the joint value grows, -1 where it falls."""
        return 1.0 if self.direction == "opening" else -1.0


def draw_style(
    asset: ArticulatedAsset,
    rng: np.random.Generator,
    *,
    direction: Direction = "opening",
    touch: GraspType = "pinch",
    outcome: Outcome = "moves",
    moving_share: float | None = None,
) -> DemonstrationStyle:
    """A random style for an asset, whose joint gives the range and whose handle the lever.

    Args:
        direction, touch, outcome: See `DemonstrationStyle`; `list_grasp_types` lists the touches that a part
            allows.
        moving_share: Share of the video in which the part moves, 0.03..0.85; drawn when None. It
            is met but for the random cut of the video (0.2 s at either end), by a longer video where
            the motion would be too quick.

    Not checked: whether the arm can reach it; `find_demonstration` does.
    """
    joint = asset.joint
    low, high = TRAVEL[joint.type]
    travel = float(rng.uniform(low, max(low, min(high, RANGE_SHARE * joint.upper))))
    if outcome == "nothing":
        # In the air the end effector stays nearer to the robot, where the arm cannot swing as far.
        travel = max(low, 0.6 * travel)
    start = 0.0
    if direction == "closing":
        start = float(min(travel + rng.uniform(0.0, 0.2) * travel, RANGE_SHARE * joint.upper))
    if moving_share is None:
        moving_share = float(rng.uniform(*MOVING_SHARE))
    timing = _draw_timing(asset, travel, moving_share, rng)
    if outcome == "cut":
        timing["before_s"] = max(timing["before_s"], FILM_S[0])
    slides = rng.random() < 0.6
    return DemonstrationStyle(
        travel=float(travel * rng.uniform(0.1, 1.0)) if outcome == "locked" else travel,
        direction=direction,
        start=start,
        touch=touch,
        outcome=outcome,
        follow=float(rng.uniform(0.7, 1.0)) if joint.type == "revolute" else 1.0,
        slip_m=float(rng.uniform(-1, 1) * MAX_SLIP_M) if slides else 0.0,
        grip=float(rng.uniform(*SLIDING_GRIP)) if slides else 1.0,
        pause_at=float(rng.uniform(0.3, 0.7)),
        **timing,
    )


def _draw_timing(
    asset: ArticulatedAsset, travel: float, moving_share: float, rng: np.random.Generator
) -> dict[str, float]:
    """Durations, so that the part moves in a share of the video."""
    pause_s = float(rng.uniform(0.3, MAX_PAUSE_S)) if rng.random() < 0.4 else 0.0
    # Slow starts and ends, in which the part hardly moves, leave no room for a large share.
    cruise = float(rng.uniform(0.7, 0.9) if moving_share > 0.6 else rng.uniform(0.0, 0.8))
    quick, slow = (travel * _lever(asset) * peak_speed(cruise) / speed for speed in SPEED[::-1])
    seen = _seen(travel, asset.joint.type, cruise)
    film_s = float(rng.uniform(*FILM_S))
    motion_s = float(np.clip((moving_share * film_s - pause_s) / seen, quick, slow))
    least = LEAST_BEFORE_S + LEAST_AFTER_S
    rest_s = (seen * motion_s + pause_s) / moving_share + CUT_S - motion_s - pause_s - least
    if rest_s < 0:
        rest_s = 0.0
        needed = (moving_share * (pause_s + least - CUT_S) - pause_s) / max(seen - moving_share, 0.02)
        motion_s = float(np.clip(needed, motion_s, max(slow, motion_s)))
    before = float(rest_s * rng.uniform(0.3, 0.8))
    return {
        "motion_s": motion_s,
        "cruise": cruise,
        "pause_s": pause_s,
        "before_s": LEAST_BEFORE_S + before,
        "after_s": LEAST_AFTER_S + rest_s - before,
    }


def compute_progress(u: ArrayLike, cruise: float) -> Array:
    """Share of the way (N,) after a share u (N,) of the time.

    Both ends are halves of a minimum-jerk motion, with constant speed between them; `cruise` 0 is
    minimum jerk itself. Source: Flash and Hogan, 1985.
    """
    u = np.asarray(u, np.float64)
    ramp = (1.0 - cruise) / 2
    first = 2 * ramp * 8 / 15
    if cruise == 0.0:
        return _minimum_jerk(u)
    near, far = np.minimum(u, ramp), np.minimum(1.0 - u, ramp)
    middle = np.clip(u - ramp, 0.0, cruise)
    ends = first * (_minimum_jerk(near / (2 * ramp)) + 0.5 - _minimum_jerk(far / (2 * ramp)))
    return (ends + middle) / (first + cruise)


def peak_speed(cruise: float) -> float:
    """Largest slope of `compute_progress`."""
    return 1.0 / ((1.0 - cruise) * 8 / 15 + cruise)


def _minimum_jerk(u: Array) -> Array:
    return u**3 * (10 - 15 * u + 6 * u**2)


def _lever(asset: ArticulatedAsset) -> float:
    """Path length of the handle for one unit of the joint, [m]."""
    if asset.joint.type == "prismatic":
        return 1.0
    return float(np.linalg.norm(np.cross(asset.joint.axis, asset.handle_point - asset.joint.origin)))


def _seen(travel: float, kind: str, cruise: float) -> float:
    """Share of a motion's time in which the part is away from both ends."""
    u = np.linspace(0.0, 1.0, 2001)
    away = np.abs(compute_progress(u, cruise) - 0.5) * travel < travel / 2 - MOVED[kind]
    return float(max(away.mean(), 0.1))
