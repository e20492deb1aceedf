"""Joints behind a hand's path, with truth: what AOMotion's joint estimate is held to, without pictures.

Sizes of the flaws are those measured on contact simulations (60 doors, 15 drawers): over a door's
opening the grasp slips 1 mm outwards and 1.5 mm along the bar, the handle turns by up to 0.4 of the
door's turn in the fingers, the hand tilts by 0.15 degrees. One world in seven is worse: it
slips by up to 15 mm and tilts by degrees. Geometry is off by what reconstructed parts are off by.
"""

from dataclasses import dataclass

import numpy as np

from aomgen.core.joint import Joint, JointType
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, transform
from aomgen.core.values import Array, freeze

# Shares of worlds: a door rather than a drawer, a loose grasp, geometry that misleads.
DOORS = 0.65
LOOSE = 0.15
MISLED = 0.1
# A slow grasp slips by at most this per travel, [m/m].
MAX_SLIP_RATE = 0.05
LOG_HZ = 100.0
# White noise of hand poses from a joint log (0.5 mrad a joint), [m], [rad].
LOG_SD_M, LOG_SD_RAD = 0.00025, 0.0007


@dataclass(frozen=True, slots=True, kw_only=True)
class JointWorld:
    """One hidden joint and what is seen of it.

    Attributes:
        joint: World frame, axis positive in the demonstrated direction.
        held_world: Point of the part that the hand held at first (3,), [m].
        Ts_world_ee: Hand poses (T, 4, 4) by the log, start to end of the motion.
        thetas: True joint values (T,), 0 at first.
        grasp_ee: First guess of the held point (3,), end-effector frame, [m].
        points_moving, points_static: Reconstructed parts (N, 3), world frame, [m].
        loose: Whether the grasp was a bad one.
        misled: Whether the parts' boxes say nothing about the joint.
    """

    joint: Joint
    held_world: Array
    Ts_world_ee: Array
    thetas: Array
    grasp_ee: Array
    points_moving: Array
    points_static: Array
    loose: bool
    misled: bool

    def __post_init__(self) -> None:
        freeze(self, "held_world", self.held_world, (3,))
        freeze(self, "Ts_world_ee", self.Ts_world_ee, (None, 4, 4))
        freeze(self, "thetas", self.thetas, (len(self.Ts_world_ee),))
        freeze(self, "grasp_ee", self.grasp_ee, (3,))
        freeze(self, "points_moving", self.points_moving, (None, 3))
        freeze(self, "points_static", self.points_static, (None, 3))


def draw_world(seed: int, joint_type: JointType | None = None, travel: float | None = None) -> JointWorld:
    """A joint, an object around it, a demonstration and what is reconstructed of all.

    Args:
        seed: Same seed, same world.
        joint_type, travel: Given instead of drawn, [rad] or [m].
    """
    rng = np.random.default_rng([seed, 77])
    drawn: JointType = "revolute" if rng.random() < DOORS else "prismatic"
    kind = joint_type or drawn
    box = _draw_box(rng, kind)
    usual = np.radians(rng.uniform(20, 100)) if kind == "revolute" else rng.uniform(0.05, 0.30)
    joint = Joint(type=kind, axis=box.axis, origin=box.origin, lower=0.0, upper=travel or float(usual))
    thetas = joint.upper * _progress(rng)
    loose = bool(rng.random() < LOOSE)
    Ts_part_ee, grasp = _hand_in_part(joint, box.handle, thetas, rng, loose=loose)
    Ts_world_ee = _logged(joint.motion(thetas) @ Ts_part_ee, rng)
    misled = bool(rng.random() < MISLED)
    moving, static = _reconstructed(box, rng, misled=misled)
    T_world = _anywhere(rng)
    return JointWorld(
        joint=joint.moved(T_world),
        held_world=apply(T_world, box.handle),
        Ts_world_ee=T_world @ Ts_world_ee,
        thetas=thetas,
        grasp_ee=grasp + rng.normal(size=3) * 0.005,
        points_moving=apply(T_world, moving),
        points_static=apply(T_world, static),
        loose=loose,
        misled=misled,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Box:
    """An object in its own frame: the moving part is a box from `low` to `high`, its body stands behind (+y)."""

    low: Array
    high: Array
    depth_m: float
    axis: Array
    origin: Array
    handle: Array


def _draw_box(rng: np.random.Generator, kind: JointType) -> _Box:
    """Front towards -y. A door turns about one of its four sides, a drawer comes out forwards or slides.

    The handle is opposite the hinge; hinges are a little inside the edge, anywhere in the thickness.
    """
    reach = rng.uniform(0.15, 0.60)
    other = rng.uniform(0.12, 0.45)
    thick = rng.uniform(0.015, 0.05)
    sideways = rng.random() < 0.6
    width, height = (reach * 1.06, other) if sideways else (other, reach * 1.06)
    low, high = np.array([-width / 2, 0.0, 0.0]), np.array([width / 2, thick, height])
    far = 1.0 if rng.random() < 0.5 else -1.0
    middle = (low + high) / 2
    handle = np.array([0.0, -rng.uniform(0.02, 0.05), middle[2] + rng.uniform(-0.2, 0.2) * other])
    if kind == "prismatic":
        axis = np.array([0.0, -1.0, 0.0]) if rng.random() < 0.75 else np.array([far, 0.0, 0.0])
        if rng.random() < 0.1:
            axis = _unit(rng.normal(size=3))
        return _Box(low=low, high=high, depth_m=0.3, axis=axis, origin=handle, handle=handle)
    across = 0 if sideways else 2
    origin = middle.copy()
    edge = high[across] if far > 0 else low[across]
    origin[across] = edge - far * abs(rng.normal()) * 0.006
    origin[1] = rng.uniform(0.0, thick)
    handle[across] = origin[across] - far * reach
    if not sideways:
        handle[0] = rng.uniform(-0.2, 0.2) * width
    axis = np.zeros(3)
    axis[2 - across] = 1.0
    outwards = float(np.cross(axis, handle - origin)[1])
    axis *= -1.0 if outwards > 0 else 1.0
    return _Box(low=low, high=high, depth_m=0.3, axis=axis, origin=origin, handle=handle)


def _progress(rng: np.random.Generator) -> Array:
    """Share of the travel (T,) over 2 to 5 s at the log's rate; minimum jerk, a third with a pause."""
    count = int(rng.uniform(2.0, 5.0) * LOG_HZ)
    u = np.linspace(0.0, 1.0, count)
    share = u**3 * (10 - 15 * u + 6 * u**2)
    if rng.random() < 0.3:
        at = int(rng.uniform(0.3, 0.7) * count)
        share = np.concatenate([share[:at], np.full(int(0.8 * LOG_HZ), share[at]), share[at:]])
    return share


def _hand_in_part(
    joint: Joint, handle: Array, thetas: Array, rng: np.random.Generator, *, loose: bool
) -> tuple[Array, Array]:
    """Hand poses (T, 4, 4) in the part's frame (as at value 0), and the held point in the hand's."""
    share = thetas / joint.upper
    radial, along, tangent = _held_frame(joint, handle)
    length = joint.upper * (_radius(joint, handle) if joint.type == "revolute" else 1.0)
    # A handle that does not turn in the fingers slips less: drawers by 0.2 mm over 0.18 m.
    ease = 1.0 if joint.type == "revolute" else 0.3
    usual, worst = ease * length / 0.34, ease * min(0.015, MAX_SLIP_RATE * length)
    face, bar = rng.uniform(0.2, 1.0, 2) * worst if loose else np.array([0.001, 0.0017]) * usual
    speed = np.gradient(thetas)
    lag = rng.uniform(0.001, 0.003) * (0.5 * np.minimum(1, share / 0.03) + 0.5 * speed / speed.max())
    slip = (
        np.outer(face * _slow(share, rng), radial)
        + np.outer(bar * _slow(share, rng), along)
        - np.outer(lag * (1 + 0.1 * _slow(share, rng)), tangent)
        + np.outer(0.03 * lag * rng.normal(), radial)
        + np.outer(0.03 * lag * rng.normal(), along)
    )
    # The handle turns in the fingers, about nearly the joint's axis.
    tilt = np.radians(1.5 if loose else 0.15)
    turns = np.stack([_slow(share, rng) for _ in range(3)], 1) * tilt
    if joint.type == "revolute":
        lost = (1 - rng.uniform(0.7, 1.0)) * thetas
        drift = (0.1 if loose else 0.01) * rng.normal() * joint.upper * 4 * share * (1 - share)
        turns = turns - np.outer(lost + drift, joint.axis)
    R_start = matrix_from_rotvec(rng.normal(size=3))
    grasp = rng.normal(size=3) * 0.015
    R = matrix_from_rotvec(turns) @ R_start
    return transform(R, handle + slip - slip[0] - R @ grasp), grasp


def _held_frame(joint: Joint, handle: Array) -> tuple[Array, Array, Array]:
    """Outwards, along the bar and forwards (3,) at the handle."""
    if joint.type == "prismatic":
        upright = np.array([0.0, 0.0, 1.0] if abs(joint.axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        side = np.asarray(np.cross(joint.axis, upright), np.float64)
        side = _unit(side)
        return side, np.asarray(np.cross(joint.axis, side), np.float64), joint.axis
    arm = handle - joint.origin
    radial = _unit(arm - (arm @ joint.axis) * joint.axis)
    return radial, joint.axis, np.asarray(np.cross(joint.axis, radial), np.float64)


def _radius(joint: Joint, handle: Array) -> float:
    return float(np.linalg.norm(np.cross(handle - joint.origin, joint.axis)))


def _slow(share: Array, rng: np.random.Generator) -> Array:
    """A slow course (T,) whose end has a standard deviation of 1: a steady part, a bend, a wave.

    Measured: the middle of the path is off the steady course by 0.15 to 0.3 of the end's deviation.
    """
    steady, bend, wave = rng.normal(size=3) * [1.0, 0.9, 0.15]
    return steady * share + bend * share * (1 - share) + wave * np.sin(2 * np.pi * share)


def _logged(Ts_world_ee: Array, rng: np.random.Generator) -> Array:
    noise = transform(
        matrix_from_rotvec(rng.normal(size=(len(Ts_world_ee), 3)) * LOG_SD_RAD),
        rng.normal(size=(len(Ts_world_ee), 3)) * LOG_SD_M,
    )
    about = Ts_world_ee.copy()
    about[:, :3, 3] = 0.0
    moved = noise @ about
    moved[:, :3, 3] += Ts_world_ee[:, :3, 3]
    return moved


def _reconstructed(box: _Box, rng: np.random.Generator, *, misled: bool) -> tuple[Array, Array]:
    """Points of both parts: faces off by millimetres, the whole tilted, the handle sticking out; or nonsense."""
    low = box.low + rng.normal(size=3) * 0.006
    high = np.maximum(box.high + rng.normal(size=3) * 0.006, low + 0.002)
    moving = _surface(low, high, 600, rng)
    moving = np.concatenate([moving, box.handle + rng.normal(size=(40, 3)) * [0.01, 0.004, 0.02]])
    behind = np.array([0.0, high[1] - low[1], 0.0])
    static = _surface(low + behind, high + [0.05, box.depth_m, 0.05], 1500, rng)
    # Yaw of what is seen of the object, tilt of the alignment.
    tilt = rng.normal(size=3) * np.radians([0.2, 0.2, rng.uniform(0.2, 1.5)])
    if misled:
        tilt = rng.normal(size=3)
        moving = moving * rng.uniform(0.4, 1.0, 3) + rng.normal(size=3) * 0.1
    R = matrix_from_rotvec(tilt)
    centre = moving.mean(0)
    moving, static = ((points - centre) @ R.T + centre for points in (moving, static))
    return tuple(points + rng.normal(size=points.shape) * 0.003 for points in (moving, static))  # type: ignore[return-value]


def _surface(low: Array, high: Array, count: int, rng: np.random.Generator) -> Array:
    """Points (N, 3) on the box's faces."""
    points = rng.uniform(low, high, (count, 3))
    face = rng.integers(0, 3, count)
    side = np.where(rng.random(count) < 0.5, 0, 1)
    points[np.arange(count), face] = np.where(side == 0, low[face], high[face])
    return points


def _anywhere(rng: np.random.Generator) -> Array:
    """A place on a table: yaw and shift; a fifth leans, as objects on wedges do."""
    lean = np.radians(rng.uniform(5, 40)) if rng.random() < 0.2 else 0.0
    R = matrix_from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)]) @ matrix_from_rotvec([lean, 0, 0])
    return transform(R, rng.uniform(-0.5, 0.5, 3))


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector), np.float64)


def in_part(world: JointWorld) -> Array:
    """The held point (T, 3) in the part's frame: what slipped, for looking at a world."""
    return apply(invert(world.joint.motion(world.thetas)) @ world.Ts_world_ee, world.grasp_ee)
