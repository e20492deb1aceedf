"""Grippers that hold a part while it moves: they slide, yield and tilt as in contact simulations.

Magnitudes are measured (60 doors, 15 drawers with firm grasps, 50 of five categories): while a door
opens, the grasp slips 1 mm outwards and 1.5 mm along the bar, the handle rotates in the fingers by up to
0.4 of the door's rotation, the gripper tilts by 0.15 degrees. A straight pull slips along the fingers'
pads only. In most worlds the gripper also slides along the bar, by up to 11 mm. Loose grasps slip by up
to 15 mm and tilt by degrees.
"""

import numpy as np

from aomgen.core.joint import Joint, JointType
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.core.values import Array

# A slow grasp slips by at most this per travel, [m/m].
MAX_SLIP_RATE = 0.05
# Share of grippers that slide along the bar as those of human operators do, the largest distance [m], and the
# share of that by which they yield across it, along their pads.
SLIDING = 0.6
MAX_SLIDE_M = 0.011
ASIDE = (0.3, 1.2)
# Share of pulls with fingers that close along the motion, and otherwise the tilt of the
# gripper about the bar, [rad].
CLOSING_ALONG = {"revolute": 0.6, "prismatic": 0.4}
MAX_LEAN_RAD = 0.4
# Slip per travel of firm fingers in a straight pull along their closing direction, [m/m].
CLOSING_RATE = 0.0003
LOG_HZ = 100.0
# White noise of end effector poses from a joint log (0.5 mrad per joint), [m], [rad].
LOG_SD_M, LOG_SD_RAD = 0.00025, 0.0007


def hand_in_part(
    joint: Joint, handle: Array, thetas: Array, rng: np.random.Generator, *, loose: bool
) -> tuple[Array, Array, Array]:
    """Compute end effector poses (T, 4, 4) in the part's frame (as at value 0).

    Returned with them are the held point and the closing direction in the end effector's frame.
    """
    share = thetas / joint.upper
    bar, closing, pads = _fingers(joint, handle, rng)
    length = joint.upper * (_radius(joint, handle) if joint.type == "revolute" else 1.0)
    across, along, tangent = _held_frame(joint, handle)
    ways = (across if joint.type == "revolute" else pads, bar, closing)
    slip = _slips(joint.type, ways, length, share, rng, loose=loose)
    speed = np.gradient(thetas)
    lag = rng.uniform(0.001, 0.003) * (0.5 * np.minimum(1, share / 0.03) + 0.5 * speed / speed.max())
    slip = slip - np.outer(lag * (1 + 0.1 * _slow(share, rng)), tangent)
    slip = slip + np.outer(0.03 * lag, rng.normal() * across + rng.normal() * along)
    # The handle rotates in the fingers, about nearly the joint's axis.
    tilt = np.radians(1.5 if loose else 0.15)
    turns = np.stack([_slow(share, rng) for _ in range(3)], 1) * tilt
    if joint.type == "revolute":
        lost = (1 - rng.uniform(0.7, 1.0)) * thetas
        drift = (0.1 if loose else 0.01) * rng.normal() * joint.upper * 4 * share * (1 - share)
        turns = turns - np.outer(lost + drift, joint.axis)
    R_start = matrix_from_rotvec(rng.normal(size=3))
    grasp = rng.normal(size=3) * 0.015
    R = matrix_from_rotvec(turns) @ R_start
    return transform(R, handle + slip - slip[0] - R @ grasp), grasp, R[0].T @ closing


def _slips(
    joint_type: JointType,
    ways: tuple[Array, Array, Array],
    length_m: float,
    share: Array,
    rng: np.random.Generator,
    *,
    loose: bool,
) -> Array:
    """Draw the slow slip (T, 3) of the gripper along the part, [m].

    The directions `ways` are outwards or along the pads, along the bar, and the
    fingers' closing direction (3,).
    """
    worst = rng.uniform(0.2, 1.0, 2) * min(0.015, MAX_SLIP_RATE * length_m)
    if joint_type == "revolute":
        sizes = np.append(worst if loose else np.array([0.001, 0.0017]) * length_m / 0.34, 0.0)
    else:
        # A handle that does not rotate in the fingers slips less: drawers by 0.2 mm over 0.18 m.
        usual = 0.3 * worst if loose else np.array([0.0009, 0.0015]) * length_m
        sizes = np.append(usual, CLOSING_RATE * length_m)
    slip = np.stack([size * _slow(share, rng) for size in sizes], 1) @ np.stack(ways)
    if rng.random() < SLIDING:
        end = rng.uniform(-1, 1) * MAX_SLIDE_M
        aside = rng.choice([-1, 1]) * rng.uniform(*ASIDE) if joint_type == "prismatic" else 0.0
        course = share + _slow(share, rng, steady=0.0)
        slip = slip + end * np.outer(course, ways[1] + aside * ways[0])
    return np.asarray(slip, np.float64)


def _held_frame(joint: Joint, handle: Array) -> tuple[Array, Array, Array]:
    """Return directions (3,) at the handle: outwards, along the axis (or two lateral ones), forwards."""
    if joint.type == "prismatic":
        upright = np.array([0.0, 0.0, 1.0] if abs(joint.axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        side = np.asarray(np.cross(joint.axis, upright), np.float64)
        side = _unit(side)
        return side, np.asarray(np.cross(joint.axis, side), np.float64), joint.axis
    arm = handle - joint.origin
    radial = _unit(arm - (arm @ joint.axis) * joint.axis)
    return radial, joint.axis, np.asarray(np.cross(joint.axis, radial), np.float64)


def _fingers(joint: Joint, handle: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return directions (3,): along the bar, of closing fingers, and along their pads across the bar."""
    across, bar, tangent = _held_frame(joint, handle)
    if joint.type == "prismatic" and rng.random() < 0.5:
        across, bar = bar, across
    first = tangent if rng.random() < CLOSING_ALONG[joint.type] else across
    lean = rng.uniform(-1, 1) * MAX_LEAN_RAD
    closing = matrix_from_rotvec(lean * bar) @ first
    return bar, closing, np.asarray(np.cross(bar, closing), np.float64)


def _radius(joint: Joint, handle: Array) -> float:
    return float(np.linalg.norm(np.cross(handle - joint.origin, joint.axis)))


def _slow(share: Array, rng: np.random.Generator, steady: float = 1.0) -> Array:
    """Draw a slow curve (T,) whose end has a standard deviation of `steady`: a steady part, a bend, a wave.

    Measured: the middle of the path deviates from the steady curve by 0.15 to 0.3 of the end's deviation.
    """
    steady, bend, wave = rng.normal(size=3) * [steady, 0.9, 0.15]
    return steady * share + bend * share * (1 - share) + wave * np.sin(2 * np.pi * share)


def logged(Ts_world_ee: Array, rng: np.random.Generator) -> Array:
    """Add the noise of a joint log to end effector poses (T, 4, 4)."""
    noise = transform(
        matrix_from_rotvec(rng.normal(size=(len(Ts_world_ee), 3)) * LOG_SD_RAD),
        rng.normal(size=(len(Ts_world_ee), 3)) * LOG_SD_M,
    )
    about = Ts_world_ee.copy()
    about[:, :3, 3] = 0.0
    moved = noise @ about
    moved[:, :3, 3] += Ts_world_ee[:, :3, 3]
    return moved


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector), np.float64)
