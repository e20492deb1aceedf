"""Contact of a gripper's pads with the visible meshes of a held asset, which the simulation does not use."""

from collections.abc import Callable
from functools import cache
from typing import Final, NamedTuple

import numpy as np

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.demonstration import Demonstration
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.episodes.candidates import list_motions
from aomgen.episodes.retarget import MOVE, DemonstratedMotion, RetargetedMotion
from aomgen.robots.robot import FingerPad, RobotModel

# Distance between points of a surface, and from the held point to the farthest of them, [m].
SPACING_M, NEAR_M = 1e-3, 0.06
# Points farther behind a pad's face are on the other side of the finger, [m].
BEHIND_M: Final = 0.012
# Bisections of the gripper's range until its value is known: to far below a tenth of a millimetre.
HALVINGS: Final = 12
# Points along each side of a box.
BOX_STEPS: Final = 41
# Number of measured poses of the contact: the pads touch the handle in the same manner along it.
POSES: Final = 5
# Pads with a larger gap hold nothing, and pads that are deeper cut into the visible surface, [mm].
MAX_GAP_MM, MAX_PENETRATION_MM = 3.0, 2.0


class Grip(NamedTuple):
    """Worst value over the contact and both fingers, [mm]; an infinite gap where the pads enclose nothing.

    `tried` counts the grasps that were examined before it.
    """

    gap_mm: float
    penetration_mm: float
    tried: int = 0

    @property
    def holds(self) -> bool:
        """Return whether the pads touch the meshes without penetrating them."""
        return self.gap_mm <= MAX_GAP_MM and self.penetration_mm <= MAX_PENETRATION_MM


def grip_on_meshes(fitted: FittedAsset, demo: Demonstration, robot: RobotModel) -> Grip:
    """Close the pads on the colliders and measure their contact with the meshes.

    The result is that of the first grasp that holds, in the order of planning; else of the first grasp.
    Not checked: reachability, and the fingers next to their pads; planning checks these on colliders.
    """
    shown = DemonstratedMotion(demo)
    boxes, surface = (_near(points(fitted.asset), fitted) for points in (_box_points, _mesh_points))
    motions = list_motions(fitted, shown, fitted.T_world_asset, robot)
    pads = cache(lambda gripper: _pad_poses(robot, gripper))
    grips = (_grip(motion, pads, boxes, surface)._replace(tried=k) for k, motion in enumerate(motions))
    first = next(grips)
    return first if first.holds else next((grip for grip in grips if grip.holds), first)


# Pads and their poses in the end effector's frame (4, 4), by the gripper's value.
Pads = Callable[[float], list[tuple[FingerPad, Array]]]


def _grip(motion: RetargetedMotion, pads: Pads, boxes: Array, surface: Array) -> Grip:
    """Measure the contact of one grasp, on points of colliders and meshes (N, 3)."""
    knots, fitted = motion.shown.knots[MOVE], motion.fitted
    times = np.linspace(knots[0], knots[-1], POSES)
    moved = fitted.T_world_asset @ fitted.asset.joint.motion(motion.thetas(times))
    Ts_part_ee = invert(moved) @ motion.holding(times)
    clearances = [_clearances(pads(_stall(pads, T, boxes)), T, surface) for T in Ts_part_ee]
    low, high = np.min(clearances), np.max(clearances)
    return Grip(gap_mm=1000 * max(float(high), 0.0), penetration_mm=1000 * max(-float(low), 0.0))


def _stall(pads: Pads, T_part_ee: Array, points: Array) -> float:
    """Find the gripper value at which the pads, on average, touch points (N, 3)."""
    opened, closed = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = (opened + closed) / 2
        touches = sum(_clearances(pads(middle), T_part_ee, points)) <= 0
        opened, closed = (opened, middle) if touches else (middle, closed)
    return opened


def _pad_poses(robot: RobotModel, gripper: float) -> list[tuple[FingerPad, Array]]:
    joints = np.zeros((1, len(robot.joint_names)))
    Ts_ee_body = invert(robot.ee_poses(joints)[0]) @ robot.link_poses(joints, gripper)[0]
    return [(pad, Ts_ee_body[pad.body] @ pad.T_body_pad) for pad in robot.pads]


def _clearances(pads: list[tuple[FingerPad, Array]], T_part_ee: Array, points: Array) -> list[float]:
    """Measure the distance of points (N, 3) before the pads from their faces, below 0 inside, [m]."""
    return [_clearance(pad, T_part_ee @ T_ee_pad, points) for pad, T_ee_pad in pads]


def _clearance(pad: FingerPad, T_part_pad: Array, points: Array) -> float:
    local = apply(invert(T_part_pad), points)
    heights = local[:, 2] - pad.half_extents[2]
    before = (np.abs(local[:, :2]) <= pad.half_extents[:2]).all(1) & (heights > -BEHIND_M)
    return float(heights[before].min(initial=np.inf))


def _box_points(asset: ArticulatedAsset) -> Array:
    """Sample points (N, 3) on the held colliders: the handle's boxes, or all of the part."""
    steps = np.linspace(-1, 1, BOX_STEPS)
    cube = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    cube = cube[np.abs(cube).max(1) == 1]
    return np.concatenate(
        [apply(b.T_asset_box, cube * b.half_extents) for b in asset.handle_boxes or asset.moving.colliders]
    )


def _mesh_points(asset: ArticulatedAsset) -> Array:
    """Sample points (N, 3) all over the visible moving part."""
    rng = np.random.default_rng(0)
    points = []
    for mesh in asset.moving.meshes:
        area = face_normals_areas(mesh.vertices, mesh.faces)[1].sum()
        count = int(area / SPACING_M**2) + 1
        points += [sample_surface(mesh.vertices, mesh.faces, count, rng)[0], mesh.vertices]
    return np.concatenate(points)


def _near(points: Array, fitted: FittedAsset) -> Array:
    return points[np.linalg.norm(points - fitted.contact_asset, axis=1) < NEAR_M]
