"""Joints behind an end effector's path, with truth: test data of AOMotion's joint estimate, without images.

One world in seven has a loose grasp. The geometry has the errors of reconstructed parts.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from aomgen.core.joint import Joint, JointType
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, transform
from aomgen.core.values import Array, Vector3, freeze_arrays
from benchmarks.joint_hands import LOG_HZ, hand_in_part, logged

# Shares of worlds: a door rather than a drawer, a loose grasp, geometry that misleads.
DOORS = 0.65
LOOSE = 0.15
MISLED = 0.1
# Error of the first estimate of the held point in each direction (patches of 25 simulated demonstrations have
# an error of 8.6 mm in all, root mean square), [m].
GRASP_SD_M = 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class JointWorld:
    """One hidden joint and its observations.

    Attributes:
        joint: World frame, axis positive in the demonstrated direction.
        held_world: Point of the part that the gripper held at first (3,), [m].
        Ts_world_ee: End effector poses (T, 4, 4) by the log, start to end of the motion.
        thetas: True joint values (T,), 0 at first.
        grasp_ee: First estimate of the held point (3,), end-effector frame, [m].
        closing_ee: Unit direction in which the fingers close (3,), same frame.
        points_moving, points_static: Reconstructed parts (N, 3), world frame, [m].
        loose: Whether the grasp was loose.
        misled: Whether the parts' boxes are unrelated to the joint.
    """

    joint: Joint
    held_world: Vector3
    Ts_world_ee: Annotated[Array, "T 4 4"]
    thetas: Annotated[Array, "T"]
    grasp_ee: Vector3
    closing_ee: Vector3
    points_moving: Annotated[Array, "_ 3"]
    points_static: Annotated[Array, "_ 3"]
    loose: bool
    misled: bool

    __post_init__ = freeze_arrays


def draw_world(seed: int, joint_type: JointType | None = None, travel: float | None = None) -> JointWorld:
    """Draw a joint, an object around it, a demonstration and their reconstruction.

    Args:
        seed: Equal seeds give equal worlds.
        joint_type, travel: Given values instead of drawn ones, [rad] or [m].
    """
    rng = np.random.default_rng([seed, 77])
    drawn: JointType = "revolute" if rng.random() < DOORS else "prismatic"
    kind = joint_type or drawn
    box = _draw_box(rng, kind)
    usual = np.radians(rng.uniform(20, 100)) if kind == "revolute" else rng.uniform(0.05, 0.30)
    joint = Joint(type=kind, axis=box.axis, origin=box.origin, lower=0.0, upper=travel or float(usual))
    thetas = joint.upper * _progress(rng)
    loose = bool(rng.random() < LOOSE)
    Ts_part_ee, grasp, closing = hand_in_part(joint, box.handle, thetas, rng, loose=loose)
    Ts_world_ee = logged(joint.motion(thetas) @ Ts_part_ee, rng)
    misled = bool(rng.random() < MISLED)
    moving, static = _reconstructed(box, rng, misled=misled)
    T_world = _anywhere(rng)
    return JointWorld(
        joint=joint.move(T_world),
        held_world=apply(T_world, box.handle),
        Ts_world_ee=T_world @ Ts_world_ee,
        thetas=thetas,
        grasp_ee=grasp + rng.normal(size=3) * GRASP_SD_M,
        closing_ee=closing,
        points_moving=apply(T_world, moving),
        points_static=apply(T_world, static),
        loose=loose,
        misled=misled,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Box:
    """An object in its own frame: its moving part is a box from `low` to `high` before its body (+y)."""

    low: Array
    high: Array
    depth_m: float
    axis: Array
    origin: Array
    handle: Array


def _draw_box(rng: np.random.Generator, kind: JointType) -> _Box:
    """Draw a box with its front towards -y: a door on one of its four sides, a drawer, or a sliding panel.

    The handle is opposite the hinge; hinges are slightly inside the edge, anywhere in the thickness.
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
    """Draw the share of the travel (T,) over 2 to 5 s: minimum jerk, a third with a pause."""
    count = int(rng.uniform(2.0, 5.0) * LOG_HZ)
    u = np.linspace(0.0, 1.0, count)
    share = u**3 * (10 - 15 * u + 6 * u**2)
    if rng.random() < 0.3:
        at = int(rng.uniform(0.3, 0.7) * count)
        share = np.concatenate([share[:at], np.full(int(0.8 * LOG_HZ), share[at]), share[at:]])
    return share


def _reconstructed(box: _Box, rng: np.random.Generator, *, misled: bool) -> tuple[Array, Array]:
    """Sample points of both parts with displaced faces, a tilt and a handle; or unrelated ones."""
    low = box.low + rng.normal(size=3) * 0.006
    high = np.maximum(box.high + rng.normal(size=3) * 0.006, low + 0.002)
    moving = _surface(low, high, 600, rng)
    moving = np.concatenate([moving, box.handle + rng.normal(size=(40, 3)) * [0.01, 0.004, 0.02]])
    behind = np.array([0.0, high[1] - low[1], 0.0])
    static = _surface(low + behind, high + [0.05, box.depth_m, 0.05], 1500, rng)
    # The rotation combines the yaw error of a partly seen object and the tilt of the alignment.
    tilt = rng.normal(size=3) * np.radians([0.2, 0.2, rng.uniform(0.2, 1.5)])
    if misled:
        tilt = rng.normal(size=3)
        moving = moving * rng.uniform(0.4, 1.0, 3) + rng.normal(size=3) * 0.1
    R = matrix_from_rotvec(tilt)
    centre = moving.mean(0)
    moving, static = ((points - centre) @ R.T + centre for points in (moving, static))
    return tuple(points + rng.normal(size=points.shape) * 0.003 for points in (moving, static))  # type: ignore[return-value]


def _surface(low: Array, high: Array, count: int, rng: np.random.Generator) -> Array:
    """Sample points (N, 3) on the box's faces."""
    points = rng.uniform(low, high, (count, 3))
    face = rng.integers(0, 3, count)
    side = np.where(rng.random(count) < 0.5, 0, 1)
    points[np.arange(count), face] = np.where(side == 0, low[face], high[face])
    return points


def _anywhere(rng: np.random.Generator) -> Array:
    """Draw a pose on a table: yaw and shift; a fifth is tilted, as objects on wedges are."""
    lean = np.radians(rng.uniform(5, 40)) if rng.random() < 0.2 else 0.0
    R = matrix_from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)]) @ matrix_from_rotvec([lean, 0, 0])
    return transform(R, rng.uniform(-0.5, 0.5, 3))


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector), np.float64)


def in_part(world: JointWorld) -> Array:
    """Compute the held point (T, 3) in the part's frame, which shows the slip."""
    return apply(invert(world.joint.motion(world.thetas)) @ world.Ts_world_ee, world.grasp_ee)
