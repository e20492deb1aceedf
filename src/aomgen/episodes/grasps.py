"""Grasps for the new handle: the demonstrated one first, then grasps near it.

In the end effector frame of every robot z points out of the palm and the fingers close along y, so that
a held bar lies along x.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Annotated

import numpy as np

from aomgen.assets.asset_check import held_at_rim, outward_normal
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import angle_between, invert, matrix_from_rotvec, rotvec_from_matrix
from aomgen.core.values import Array, Vector3, freeze_arrays
from aomgen.robots.robot import RobotModel

# Rotations of the gripper that are tried, the smallest first, [deg]: about the handle, and along it.
TILTS_DEG, SWINGS_DEG = (0.0, 15.0, -15.0, 30.0, -30.0, 45.0, -45.0), (20.0, -20.0, 40.0, -40.0)
# Distances of a held bar beyond the end effector point, [m]: adaptive fingers that hold it with the inner
# half of their pads let it slip towards the palm.
DEPTHS_M = (0.006, 0.012)
# Distances of the fingertips beyond the held point of a rim, the largest first, [m]: a stiff, heavy lid slips
# off greasy fingers at a smaller distance, but an obstacle below a lid may leave them no more room.
RIM_OVERLAPS_M = (0.006, 0.004)
# Cosines: for a bar that is closer to parallel to the approach, the grasp is made square; fingers that close
# less across the plate of a rim slip off when it is slippery.
MAX_ALONG_BAR, MIN_ACROSS_RIM = 0.6, 0.7
# A square orientation is tried only if it differs by more than this.
MIN_LEVELLED_RAD = np.deg2rad(5.0)
# Rotation ratio for an end effector that cannot rotate as far as the door: the
# bar rotates between its fingers.
LOOSE_RATIO = 0.7


@dataclass(frozen=True, slots=True, kw_only=True)
class Grasp:
    """One grasp of the handle.

    Attributes:
        R_object_ee: Orientation of the end effector at the closed part.
        held_ee: Held point in the end effector frame, [m].
        turn_ratio: Rotation of the end effector over rotation of the part.
    """

    name: str
    R_object_ee: Annotated[Array, "3 3"]
    held_ee: Vector3
    turn_ratio: float

    __post_init__ = freeze_arrays


def orientations(
    R_front_ee: Array, handle_axis: Array, tilts_deg: tuple[float, ...]
) -> Iterator[tuple[str, Array]]:
    """Yield orientations whose fingers close across the handle, nearest to the demonstrated first.

    Args:
        R_front_ee: Demonstrated orientation at the closed part, in the recorded object's upright front frame
            (3, 3); the asset's own frame is of the same kind.
        handle_axis: Direction of the new handle's bar (3,), asset frame, part closed.

    Yields:
        Name and R_asset_ee (3, 3): with the demonstrated approach direction, then with the end effector
        square to the bar, each with every tilt; then tilted along the bar, likewise; last the
        end effector rotated by half a turn, which swaps the fingers.
    """
    bar = R_front_ee[:, 0]
    near = handle_axis if bar @ handle_axis >= 0 else -handle_axis
    level = _least_turn(bar, near) @ R_front_ee
    bases = [("", _across(R_front_ee, near))]
    if abs(R_front_ee[:, 2] @ near) > MAX_ALONG_BAR:
        bases = []
    if not bases or angle_between(bases[0][1][:, 2], level[:, 2]) > MIN_LEVELLED_RAD:
        bases.append(("level ", level))
    for label, base in bases:
        for tilt in tilts_deg:
            yield f"{label}tilt {tilt:+.0f}", matrix_from_rotvec(np.deg2rad(tilt) * handle_axis) @ base
    first = bases[0][1]
    for swing in SWINGS_DEG:
        swung = first @ matrix_from_rotvec(np.deg2rad(swing) * np.array([0.0, 1.0, 0.0]))
        for tilt in tilts_deg:
            R = matrix_from_rotvec(np.deg2rad(tilt) * handle_axis) @ swung
            yield f"swing {swing:+.0f}, tilt {tilt:+.0f}", R
    yield "turned", matrix_from_rotvec(np.pi * first[:, 2]) @ first


def grasp_depths(asset: ArticulatedAsset, demonstrated_depth: float, robot: RobotModel) -> tuple[float, ...]:
    """Return distances of the held handle beyond the end effector point, the best first, [m].

    A bar is held at the recorded distance; a rim is held by the fingertips,
    whatever was held in the recording.
    """
    if not (robot.pads and held_at_rim(asset)):
        return (float(np.clip(demonstrated_depth, *DEPTHS_M)),)
    joints = np.zeros((1, len(robot.joint_names)))
    Ts_ee_body = invert(robot.ee_poses(joints)) @ robot.link_poses(joints, 1.0)[0]
    Ts_ee_pad = [Ts_ee_body[pad.body] @ pad.T_body_pad for pad in robot.pads]
    halves = [np.abs(T[2, :3]) @ pad.half_extents for T, pad in zip(Ts_ee_pad, robot.pads, strict=True)]
    tips = float(min(T[2, 3] + half for T, half in zip(Ts_ee_pad, halves, strict=True)))
    return tuple(tips - overlap for overlap in RIM_OVERLAPS_M)


def grasps(
    fitted: FittedAsset,
    R_front_ee: Array,
    depths: Sequence[float],
    turn_ratio: float,
    usual: Grasp | None = None,
) -> Iterator[Grasp]:
    """Yield grasps to try, for one depth after the other.

    For each depth, those most similar to the usual grasp come first, or else to the demonstrated one.

    Args:
        R_front_ee: See `orientations`.
        depths: Result of `grasp_depths`, [m].
        turn_ratio: Demonstrated rotation of the end effector over rotation of the part; smaller ratios are
            tried for a revolute part.
        usual: See `grasp_choice`; possibly another object's.
    """
    asset, revolute = fitted.asset, fitted.asset.joint.type == "revolute"
    ratio = float(np.clip(turn_ratio, 0.0, 1.0)) if revolute else 1.0
    ratios = (ratio, LOOSE_RATIO) if revolute and ratio > LOOSE_RATIO + 0.1 else (ratio,)
    plate = np.cross(asset.handle_axis, outward_normal(asset)) if held_at_rim(asset) else None
    ways = [
        Grasp(name=f"{name}, turn {share:.2f}", R_object_ee=R, held_ee=np.zeros(3), turn_ratio=share)
        for name, R in orientations(R_front_ee, asset.handle_axis, TILTS_DEG)
        for share in ratios
        if plate is None or abs(plate @ R[:, 1]) >= MIN_ACROSS_RIM
    ]
    if usual is not None:
        ways.sort(key=lambda way: round(difference(way, usual), 6))
    for depth, way in product(depths, ways):
        yield replace(way, held_ee=np.array([0.0, 0.0, depth]))


def difference(a: Grasp, b: Grasp) -> float:
    """Compute the angle between grasps at the closed part plus its growth per radian of the part, [rad]."""
    turn = rotvec_from_matrix(a.R_object_ee.T @ b.R_object_ee)
    return float(np.linalg.norm(turn)) + abs(a.turn_ratio - b.turn_ratio)


def between(a: Grasp, b: Grasp, share: float) -> Grasp:
    """Interpolate by a share between grasps a and b, at b's depth."""
    turn = rotvec_from_matrix(a.R_object_ee.T @ b.R_object_ee)
    return Grasp(
        name=f"{share:.1%} from {a.name} to {b.name}",
        R_object_ee=a.R_object_ee @ matrix_from_rotvec(share * turn),
        held_ee=b.held_ee,
        turn_ratio=(1 - share) * a.turn_ratio + share * b.turn_ratio,
    )


def _across(R: Array, bar: Array) -> Array:
    """Roll an orientation about its approach by at most 90 degrees until the fingers close across the bar."""
    approach, closing = R[:, 2], R[:, 1]
    side = np.cross(approach, closing)
    angle = np.arctan2(-(closing @ bar), side @ bar)
    angle = (angle + np.pi / 2) % np.pi - np.pi / 2
    return matrix_from_rotvec(angle * approach) @ R


def _least_turn(a: Array, b: Array) -> Array:
    """Find the rotation (3, 3) by the least angle that takes unit vector a to unit vector b, a @ b >= 0."""
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    return matrix_from_rotvec(axis / sine * np.arctan2(sine, float(a @ b)))
