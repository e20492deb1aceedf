"""Timed commands of the arm in a demonstration."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.interpolate import CubicSpline

from aomgen.core.values import Array, freeze_arrays
from synthetic.style import DemonstrationStyle, compute_progress

# Step of control and physics, [s]: 500 Hz, as a UR5e is driven.
CONTROL_STEP_S = 0.002
# Seconds of each phase around the motion: reach, approach, take hold; let go, retreat.
REACH_S, APPROACH_S, HOLD_S, RELEASE_S, RETREAT_S = 1.8, 1.0, 0.7, 0.6, 0.9
# Rest of the arm at both ends, at least: the log begins before the video and ends after it.
REST_BEFORE_S, REST_AFTER_S = 0.8, 0.5
# The video of a "cut" demonstration ends this long before the motion.
BEFORE_MOTION_S = 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandedTrajectory:
    """Commands of the robot every CONTROL_STEP_S from 0: joints [rad] and closing of the gripper, 0..1.

    Attributes:
        grip: Share of its force with which the gripper closes.
        theta_start: Joint value of the object before, [rad] or [m].
        motion_s: Beginning and end of the commanded motion of the part.
        film_s: Interval that may be recorded, [s].
    """

    times_s: Annotated[Array, "T"]
    joints: Annotated[Array, "T _"]
    gripper: Annotated[Array, "_"]
    grip: float
    theta_start: float
    motion_s: tuple[float, float]
    film_s: tuple[float, float]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class PhasePaths:
    """The arm's joints at rest (J,) and in each phase (N, J); the gripper's closing while it reaches and holds, 0..1."""

    rest: Array
    approach: Array
    hold: Array
    motion: Array
    release: Array
    retreat: Array
    gripper: tuple[float, float]


def time_phases(way: PhasePaths, style: DemonstrationStyle) -> CommandedTrajectory:
    """Smooth timing of every phase: minimum jerk, the motion itself as the style says."""
    rest_before = max(style.before_s - REACH_S - APPROACH_S - HOLD_S, REST_BEFORE_S)
    rest_after = max(style.after_s - RELEASE_S - RETREAT_S, REST_AFTER_S)
    away, held = way.gripper
    stay_before, stay_after = np.repeat(way.rest[None], 2, 0), np.repeat(way.retreat[-1:], 2, 0)
    phases = [
        (stay_before, (away, away), _eased(rest_before)),
        (np.stack([way.rest, way.approach[0]]), (away, away), _eased(REACH_S)),
        (way.approach, (away, away), _eased(APPROACH_S)),
        (way.hold, (away, held), _eased(HOLD_S)),
        (way.motion, (held, held), _motion(style)),
        (way.release, (held, away), _eased(RELEASE_S)),
        (way.retreat, (away, away), _eased(RETREAT_S)),
        (stay_after, (away, away), _eased(rest_after)),
    ]
    joints, gripper, begins = [], [], [0]
    for path, (first, last), share in phases:
        joints.append(_along(path, share))
        gripper.append(first + (last - first) * np.clip(np.arange(len(share)) / (0.7 * len(share)), 0, 1))
        begins.append(begins[-1] + len(share))
    stacked = np.concatenate([*joints, stay_after[-1:]])
    begin, end = (CONTROL_STEP_S * begins[i] for i in (4, 5))
    last = CONTROL_STEP_S * begins[-1]
    return CommandedTrajectory(
        times_s=np.arange(len(stacked), dtype=np.float64) * CONTROL_STEP_S,
        joints=stacked,
        gripper=np.concatenate([*gripper, np.full(1, away)]),
        grip=style.grip,
        theta_start=style.start,
        motion_s=(begin, end),
        film_s=(
            begin - style.before_s,
            begin - BEFORE_MOTION_S if style.outcome == "cut" else min(end + style.after_s, last),
        ),
    )


def _eased(seconds: float) -> Array:
    return compute_progress(_clock(seconds), 0.0)


def _motion(style: DemonstrationStyle) -> Array:
    """Progress (N,) of the motion, with its pause."""
    if style.pause_s == 0.0:
        return compute_progress(_clock(style.motion_s), style.cruise)
    first = style.pause_at * compute_progress(_clock(style.pause_at * style.motion_s), style.cruise)
    rest = 1.0 - style.pause_at
    second = style.pause_at + rest * compute_progress(_clock(rest * style.motion_s), style.cruise)
    return np.concatenate([first, np.full(len(_clock(style.pause_s)), style.pause_at), second])


def _clock(seconds: float) -> Array:
    count = round(seconds / CONTROL_STEP_S)
    return np.arange(count) / count


def _along(path: Array, share: Array) -> Array:
    if len(path) == 2:
        return path[0] + share[:, None] * (path[1] - path[0])
    return CubicSpline(np.linspace(0, 1, len(path)), path)(share)
