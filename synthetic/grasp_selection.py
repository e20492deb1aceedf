"""Choice of the point where a gripper pinches, hooks or pushes a part."""

from dataclasses import replace
from typing import Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from aomgen.assets.asset_check import held_at_rim, outward_normal
from aomgen.core.asset import ArticulatedAsset, BoxCollider
from aomgen.core.motion import Direction
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.simulation.collision_check import holding_gripper
from synthetic.grasp import (
    BAR_BEHIND_TIP_M,
    DemonstratedGrasp,
    GraspStyle,
    draw_grasp_style,
    gripper_axes,
    measure_closed_tips,
)
from synthetic.style import DemonstrationStyle, GraspType

# Reach of the finger tips beyond the held point of a rim, and free distance of each before it closes, [m].
RIM_ROOM_M: Final = 0.004
# A push on the front begins this far before it touches, [m].
PUSH_SLACK_M: Final = 0.008
# A hooking finger stays this far off the front, [m].
HOOK_ROOM_M: Final = 0.002
# Cosine beyond which a push goes against the front, and not along it.
PUSH_LIMIT: Final = 0.5
# Share of a lid's turn by which the end effector begins flatter: an arm looks down easily, hardly up.
NOD_SHARE: Final = 0.25
# A lid that is held at its rim is found closed in this share of the cases, else ajar by so much, [rad].
CLOSED_SHARE, AJAR_RAD = 0.4, (np.deg2rad(3.0), np.deg2rad(12.0))
# Downward tilt of the end effector at a rim, [rad]: its knuckles stay above the table; and the style's share in it.
RIM_TILT_RAD, RIM_TILT_SHARE = np.deg2rad(30.0), 0.5


def draw_usual_style(
    asset: ArticulatedAsset, rng: np.random.Generator
) -> tuple[DemonstrationStyle, GraspStyle]:
    """A random pinch that opens the object far enough to be a demonstration."""
    upper = asset.joint.upper
    if asset.joint.type == "revolute":
        travel = min(np.deg2rad(rng.uniform(48, 70)), 0.8 * upper)
    else:
        travel = min(rng.uniform(0.15, 0.22), 0.9 * upper)
    style = DemonstrationStyle(travel=float(travel))
    grasp_style = draw_grasp_style(rng, style)
    style = replace(style, follow=rng.uniform(0.6, 1.0))
    if asset.joint.type == "revolute" and held_at_rim(asset) and rng.random() > CLOSED_SHARE:
        style = replace(style, start=float(rng.uniform(*AJAR_RAD)))
    return style, grasp_style


def _pinch(
    robot: RobotModel, asset: ArticulatedAsset, grasp_style: GraspStyle, style: DemonstrationStyle
) -> DemonstratedGrasp:
    """The end effector approaches the front from a little above; its fingers close across the bar.

    A lid turns the end effector further down as it opens, so that it begins by as much flatter.
    """
    approach = -outward_normal(asset)
    along = asset.handle_axis * (-1.0 if grasp_style.flip else 1.0)
    R = np.stack([along, np.cross(approach, along), approach], 1)
    # The end effector comes from above: turn about the horizontal axis of the front, right of approach.
    sideways = np.cross(approach, [0.0, 0.0, 1.0])
    tilt = grasp_style.tilt_rad
    if asset.joint.type == "revolute":
        tilt += NOD_SHARE * style.follow * max(style.start, style.goal) * float(asset.joint.axis @ sideways)
    R = matrix_from_rotvec(-tilt * sideways) @ R @ gripper_axes(robot).T
    point = asset.handle_point
    T_asset_ee = transform(R, point)
    return DemonstratedGrasp(T_asset_ee=T_asset_ee, pivot=point, slack=np.zeros(3), gripper=(0.0, 1.0))


def _pinch_rim(
    robot: RobotModel,
    asset: ArticulatedAsset,
    grasp_style: GraspStyle,
    style: DemonstrationStyle,
    tips: Array,
) -> DemonstratedGrasp:
    """The fingers, hardly open, reach over and under the rim of the part from a little above, and close."""
    outward, along = outward_normal(asset), asset.handle_axis
    across = np.cross(outward, along)
    tilt = RIM_TILT_RAD + RIM_TILT_SHARE * grasp_style.tilt_rad
    if style.direction == "closing":
        # The end effector turns less than the lid, and must be as steep once it is closed.
        tilt -= (1.0 - style.follow) * style.travel
    approach = matrix_from_rotvec(-tilt * np.cross(-outward, [0.0, 0.0, 1.0])) @ -outward
    width = along * (-1.0 if grasp_style.flip else 1.0)
    R = np.stack([width, np.cross(approach, width), approach], 1) @ gripper_axes(robot).T
    point = asset.handle_point - (tips[1, 2] - RIM_ROOM_M) * approach
    # Across tilted fingers the rim is thicker.
    bar = asset.handle_bar
    thickness = 0.0 if bar is None else 2 * _support(bar, across)
    opening = thickness * np.cos(tilt) + 2 * RIM_ROOM_M * abs(np.sin(tilt)) + 2 * RIM_ROOM_M
    return DemonstratedGrasp(
        T_asset_ee=transform(R, point),
        pivot=asset.handle_point,
        slack=np.zeros(3),
        gripper=(holding_gripper(robot, opening, 0.0), 1.0),
    )


def list_grasp_types(asset: ArticulatedAsset, direction: Direction) -> tuple[GraspType, ...]:
    """Grasp types with which a gripper can move a part: what opens against the gripper is hooked, the rest pushed."""
    facing = _facing(asset, direction)
    bare = asset.handle_bar is None or find_handle_mount(asset) is None
    if facing > PUSH_LIMIT:
        return ("pinch",) if bare else ("pinch", "hook")
    return ("pinch",) if bare and facing >= -PUSH_LIMIT else ("pinch", "push")


def choose_grasp(
    robot: RobotModel,
    model: mujoco.MjModel,
    asset: ArticulatedAsset,
    grasp_style: GraspStyle,
    style: DemonstrationStyle,
) -> DemonstratedGrasp | None:
    """Contact of the gripper with the part in a style; None where that style leaves no room.

    Args:
        model: Any compiled model that holds the robot.
        style: Style with a possible touch.
    """
    if style.touch == "pinch" and not held_at_rim(asset):
        return _pinch(robot, asset, grasp_style, style)
    tips = measure_closed_tips(robot, model)
    if style.touch == "pinch":
        return _pinch_rim(robot, asset, grasp_style, style, tips)
    if style.touch == "hook":
        return _hook(robot, asset, grasp_style, tips)
    if _facing(asset, style.direction) < -PUSH_LIMIT:
        return _push_front(robot, asset, grasp_style, tips)
    return _push_bar(robot, asset, grasp_style, style, tips)


def _hook(
    robot: RobotModel, asset: ArticulatedAsset, grasp_style: GraspStyle, tips: Array
) -> DemonstratedGrasp | None:
    """Closed fingers reach behind the bar from its side, their width across, and pull it.

    None where the bar leaves no room.
    """
    normal, along = outward_normal(asset), asset.handle_axis
    bar, foot = asset.handle_bar, find_handle_mount(asset)
    if bar is None or foot is None:
        return None
    slant = grasp_style.side * grasp_style.slant_rad
    approach = matrix_from_rotvec(slant * along) @ -normal
    closing = along * (-1.0 if grasp_style.flip else 1.0)
    width = np.cross(closing, approach)
    # The side of the fingers that looks away from the front pulls.
    pulling = width * np.sign(width @ normal)
    half = (tips[1, 0] - tips[0, 0]) / 2
    behind = _support(bar, pulling) + half
    point = asset.handle_point - behind * pulling - (tips[1, 2] - BAR_BEHIND_TIP_M) * approach
    # Deepest corner of the fingers, and how far it stays off the front.
    corner = point + tips[1, 2] * approach - half * pulling
    room = float((corner - foot) @ normal)
    if room < HOOK_ROOM_M:
        return None
    return _closed_hand(robot, closing, approach, point, slack=-min(room / 2, 0.004) * normal)


def _push_bar(
    robot: RobotModel,
    asset: ArticulatedAsset,
    grasp_style: GraspStyle,
    style: DemonstrationStyle,
    tips: Array,
) -> DemonstratedGrasp | None:
    """Closed fingers next to the bar push it along the front."""
    bar = asset.handle_bar
    if bar is None:
        return None
    approach = -outward_normal(asset)
    along = style.sign * _first_motion(asset)
    along = along - (along @ approach) * approach
    along = along / np.linalg.norm(along)
    closing = along * (-1.0 if grasp_style.flip else 1.0)
    half = (tips[1, 1] - tips[0, 1]) / 2
    point = asset.handle_point - (_support(bar, along) + half) * along
    point = point - (tips[1, 2] - BAR_BEHIND_TIP_M) * approach
    return _closed_hand(robot, closing, approach, point, slack=-PUSH_SLACK_M * along)


def _push_front(
    robot: RobotModel, asset: ArticulatedAsset, grasp_style: GraspStyle, tips: Array
) -> DemonstratedGrasp | None:
    """Closed finger tips push on the front, next to the bar.

    None where the front ends there, or the push is nearer to the hinge than half the handle is.
    """
    foot = find_handle_mount(asset)
    if foot is None:
        return None
    normal, along = outward_normal(asset), asset.handle_axis
    across = np.cross(normal, along)
    point = foot + grasp_style.side * grasp_style.beside_m * across
    if not _on_part(asset, point - 0.002 * normal, 0.012 * across):
        return None
    if asset.joint.type == "revolute":
        arms = [np.linalg.norm(np.cross(asset.joint.axis, p - asset.joint.origin)) for p in (point, foot)]
        if arms[0] < 0.5 * arms[1]:
            return None
    closing = along * (-1.0 if grasp_style.flip else 1.0)
    place = point + tips[1, 2] * normal
    return _closed_hand(robot, closing, -normal, place, slack=PUSH_SLACK_M * normal)


def _closed_hand(
    robot: RobotModel, closing: Array, approach: Array, place: Array, *, slack: Array
) -> DemonstratedGrasp:
    """Closed fingers at a place (3,), by the direction of closing and of approach (3,)."""
    R = np.stack([np.cross(closing, approach), closing, approach], 1) @ gripper_axes(robot).T
    return DemonstratedGrasp(T_asset_ee=transform(R, place), pivot=place, slack=slack, gripper=(1.0, 1.0))


def find_handle_mount(asset: ArticulatedAsset) -> Array | None:
    """The nearest point (3,) of the part behind its handle; None where handle and part are one."""
    feet = []
    for box in asset.moving.colliders:
        if not box.name.startswith("handle"):
            local = apply(invert(box.T_asset_box), asset.handle_point)
            feet.append(apply(box.T_asset_box, np.clip(local, -box.half_extents, box.half_extents)))
    if asset.handle_bar is None or not feet or held_at_rim(asset):
        return None
    distances = np.linalg.norm(np.array(feet) - asset.handle_point, axis=1)
    nearest = int(np.argmin(distances))
    return feet[nearest] if distances[nearest] > 1e-3 else None


def _first_motion(asset: ArticulatedAsset) -> Array:
    """Direction (3,) in which the handle leaves when the value grows, asset frame at joint value 0."""
    joint = asset.joint
    if joint.type == "prismatic":
        return joint.axis
    motion = np.cross(joint.axis, asset.handle_point - joint.origin)
    return motion / np.linalg.norm(motion)


def _facing(asset: ArticulatedAsset, direction: Direction) -> float:
    """Cosine between the handle's first motion and the front's normal: 1 opens against the gripper."""
    return float(outward_normal(asset) @ _first_motion(asset)) * (1.0 if direction == "opening" else -1.0)


def _support(bar: BoxCollider, direction: ArrayLike) -> float:
    """Distance that a bar reaches from its middle along a unit direction (3,), [m]."""
    return float(np.abs(bar.T_asset_box[:3, :3].T @ np.asarray(direction, np.float64)) @ bar.half_extents)


def _on_part(asset: ArticulatedAsset, point: ArrayLike, margin: ArrayLike) -> bool:
    """Return whether a point (3,) and both neighbors at a margin (3,) lie inside one box of the part."""
    point, margin = np.asarray(point, np.float64), np.asarray(margin, np.float64)
    for box in asset.moving.colliders:
        local = apply(invert(box.T_asset_box), np.array([point - margin, point, point + margin]))
        if not box.name.startswith("handle") and (np.abs(local) <= box.half_extents + 1e-4).all():
            return True
    return False
