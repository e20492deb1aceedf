"""Tier A: does a commanded trajectory avoid collisions and reach the handle, before anything is simulated."""

from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.core.plan import Rejection
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import GeomRoles, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class KinematicLimits:
    """What tier A accepts.

    Attributes:
        max_penetration_mm: Of robot and scene, or of two parts of the robot.
        max_handle_penetration_mm: Of fingers and handle while they hold it.
        max_gap_mm: Distance between the handle and the farther pad while they hold it.
        self_margin_mm: Self penetration is measured against the robot's own overlap in its start pose.
    """

    max_penetration_mm: float = 1.0
    max_handle_penetration_mm: float = 6.0
    max_gap_mm: float = 10.0
    self_margin_mm: float = 1.0


def check_kinematics(
    scene: Scene,
    joints: Array,
    gripper: Array,
    thetas: Array,
    holding: NDArray[np.bool_],
    limits: KinematicLimits,
) -> dict[str, float] | Rejection:
    """Place robot and object along a trajectory of T samples and measure overlaps and the grip.

    Args:
        scene: With the object at its pose.
        gripper: Finger opening, 0 open .. 1 closed, as it will settle on the handle.
        holding: Frames in which fingers and handle are meant to touch.

    Returns:
        Figures `penetration_mm`, `handle_penetration_mm`, `self_penetration_mm`, `grip_gap_mm`; or a
        Rejection "collision", "self_collision", "grip_collision" or "no_grip".

    Not checked: what happens between the samples; pass a trajectory dense enough.
    """
    data = mujoco.MjData(scene.model)
    worst = {"scene": 0.0, "self": 0.0, "handle": 0.0}
    where = ""
    allowed_self = _start_overlap(scene, data, joints[0], gripper[0]) + limits.self_margin_mm
    gap = 0.0
    for qpos, holds in zip(scene.qpos(joints, gripper, thetas), holding, strict=True):
        _place(scene, data, qpos)
        for kind, depth_mm, pair in _overlaps(scene.model, data, scene.roles, bool(holds)):
            if depth_mm > worst[kind]:
                worst[kind] = depth_mm
                where = pair if kind == "scene" else where
        if holds:
            gap = max(gap, _grip_gap_mm(scene, data))
    figures = {
        "penetration_mm": worst["scene"],
        "handle_penetration_mm": worst["handle"],
        "self_penetration_mm": worst["self"],
        "grip_gap_mm": gap,
    }
    tests = [
        ("collision", "penetration_mm", limits.max_penetration_mm, f" ({where})"),
        ("self_collision", "self_penetration_mm", allowed_self, ""),
        ("grip_collision", "handle_penetration_mm", limits.max_handle_penetration_mm, ""),
        ("no_grip", "grip_gap_mm", limits.max_gap_mm, ""),
    ]
    for reason, name, limit, place in tests:
        if not figures[name] <= limit:
            detail = f"{name} is {figures[name]:.1f}, limit {limit:.1f}{place}"
            return Rejection(reason=reason, detail=detail, metrics=figures)
    return figures


def table_overlap_m(scene: Scene, joints: Array) -> float:
    """How deep a path that a real arm has taken (T, J) dips into the assumed table, [m].

    More than nothing means that the table ends before it, or that its plane is estimated too high.
    """
    data = mujoco.MjData(scene.model)
    deepest = 0.0
    for qpos in scene.qpos(joints, 0.0, 0.0):
        _place(scene, data, qpos)
        pairs = data.contact.geom
        touching = scene.roles.table[pairs].any(1) & scene.roles.robot[pairs].any(1)
        deepest = max(deepest, float(-data.contact.dist[touching].min(initial=0.0)))
    return deepest


def holding_gripper(robot: RobotModel, width_m: float, fallback: float) -> float:
    """Gripper value 0..1 at which the pads stand `width_m` apart; `fallback` for a robot without pads."""
    by_finger = {pad.finger: pad for pad in robot.pads}
    if set(by_finger) != {"left", "right"}:
        return fallback
    left, right = by_finger["left"], by_finger["right"]
    values = np.linspace(0.0, 1.0, 65)
    poses = robot.link_poses(np.zeros((len(values), len(robot.joint_names))), values)
    between = apply(poses[:, right.body], right.face_body) - apply(poses[:, left.body], left.face_body)
    widths = np.einsum("ti,ti->t", between, poses[:, left.body, :3, :3] @ left.normal_body)
    return float(np.interp(-width_m, -widths, values))


def _place(scene: Scene, data: mujoco.MjData, qpos: Array) -> None:
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.model, data)
    mujoco.mj_comPos(scene.model, data)
    mujoco.mj_collision(scene.model, data)


def _overlaps(
    model: mujoco.MjModel, data: mujoco.MjData, roles: GeomRoles, holds: bool
) -> list[tuple[str, float, str]]:
    """Kind, depth [mm] and names of every penetrating contact of the robot."""
    pairs = np.array(data.contact.geom)
    # The robot's geom first.
    pairs = np.where(roles.robot[pairs[:, :1]], pairs, pairs[:, ::-1])
    hand = roles.gripper[pairs].all(1)
    found = []
    for index in np.flatnonzero((data.contact.dist < 0) & roles.robot[pairs[:, 0]] & ~hand):
        a, b = pairs[index]
        kind = "self" if roles.robot[b] else "scene"
        if holds and roles.gripper[a] and roles.handle[b]:
            kind = "handle"
        names = f"{model.body(model.geom_bodyid[a]).name} and {model.geom(int(b)).name}"
        found.append((kind, -1000.0 * float(data.contact.dist[index]), names))
    return found


def _start_overlap(scene: Scene, data: mujoco.MjData, joints: Array, gripper: float) -> float:
    """Overlap of the robot with itself at the start, [mm]: fat colliders of a real pose."""
    _place(scene, data, scene.qpos(joints[None], gripper, 0.0)[0])
    depths = [d for kind, d, _ in _overlaps(scene.model, data, scene.roles, False) if kind == "self"]
    return max(depths, default=0.0)


def _grip_gap_mm(scene: Scene, data: mujoco.MjData) -> float:
    """Distance between the handle and the farther finger's pads, [mm]; 0 for a robot without pads."""
    handle = np.flatnonzero(scene.roles.handle if scene.roles.handle.any() else scene.roles.moving)
    gap = 0.0
    for finger in (0, 1):
        pads = np.flatnonzero(scene.roles.finger == finger)
        distances = [
            mujoco.mj_geomDistance(scene.model, data, int(pad), int(part), 0.2, None)
            for pad, part in product(pads, handle)
        ]
        gap = max(gap, min(distances, default=0.0))
    return 1000.0 * gap
