"""Where the hand is while it holds, hooks or pushes a part: its pose as the part moves."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from aomgen.assets.check import outward_normal
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, transform
from aomgen.core.values import Array, freeze
from aomgen.physics.robot import RobotModel
from aomgen.synthetic.manner import Manner

# A push beside the bar begins this far before it touches, [m].
PUSH_SLACK_M: Final = 0.008
# A hooking or pushing bar lies this far behind the finger tips, [m]: half a finger pad.
BAR_BEHIND_TIP_M: Final = 0.010


@dataclass(frozen=True, slots=True, kw_only=True)
class Style:
    """What a manner leaves open about the hand.

    Attributes:
        flip: Whether the fingers are exchanged.
        tilt_rad: Downward tilt of the approach direction.
        side: -1 or 1: from which side the hand hooks, or on which side of the bar it pushes.
        slant_rad: Angle between a hooking hand and the front's normal.
        beside_m: How far beside the bar a hand pushes on the front.
    """

    flip: bool
    tilt_rad: float
    side: float = 1.0
    slant_rad: float = 0.0
    beside_m: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Hold:
    """The hand on the part, asset frame at joint value 0.

    Attributes:
        T_asset_ee: Pose (4, 4) of the end effector in touch with the part.
        slack: Way (3,) back to where it does not touch yet, [m]; zero for fingers that close.
        gripper: Closing before and while it holds, 0..1.
    """

    T_asset_ee: Array
    slack: Array
    gripper: tuple[float, float]

    def __post_init__(self) -> None:
        freeze(self, "T_asset_ee", self.T_asset_ee, (4, 4))
        freeze(self, "slack", self.slack, (3,))


def draw_style(rng: np.random.Generator, manner: Manner) -> Style:
    """What the manner leaves open."""
    tilt, flip = np.deg2rad(rng.uniform(4, 24)), bool(rng.random() < 0.5)
    if manner.touch == "pinch":
        return Style(flip=flip, tilt_rad=tilt)
    return Style(
        flip=flip,
        tilt_rad=tilt,
        side=float(rng.choice([-1.0, 1.0])),
        slant_rad=np.deg2rad(rng.uniform(48, 66)),
        beside_m=rng.uniform(0.035, 0.09),
    )


def usual(asset: ArticulatedAsset, rng: np.random.Generator) -> tuple[Manner, Style]:
    """A random pinch that opens the object far enough to be a demonstration."""
    upper = asset.joint.upper
    if asset.joint.type == "revolute":
        travel = min(np.deg2rad(rng.uniform(48, 70)), 0.8 * upper)
    else:
        travel = min(rng.uniform(0.15, 0.22), 0.9 * upper)
    manner = Manner(travel=float(travel))
    style = draw_style(rng, manner)
    return replace(manner, follow=rng.uniform(0.6, 1.0)), style


def pinch(robot: RobotModel, asset: ArticulatedAsset, style: Style) -> Hold:
    """The hand approaches the front from a little above; its fingers close across the bar."""
    approach = -front_normal(asset)
    along = asset.handle_axis * (-1.0 if style.flip else 1.0)
    R = np.stack([along, np.cross(approach, along), approach], 1)
    # The hand comes from above: turn about the horizontal axis of the front, right of approach.
    sideways = np.cross(approach, [0.0, 0.0, 1.0])
    R = matrix_from_rotvec(-style.tilt_rad * sideways) @ R @ hand_axes(robot).T
    return Hold(T_asset_ee=transform(R, asset.handle_point), slack=np.zeros(3), gripper=(0.0, 1.0))


def hold_poses(asset: ArticulatedAsset, hold: Hold, manner: Manner, progress: ArrayLike) -> Array:
    """Poses (N, 4, 4) of the hand in the asset frame after shares (N,) of the part's way.

    It turns with its share of the part's turn, and slides along the bar as the manner says.
    """
    progress = np.asarray(progress, np.float64)
    poses = []
    for share in progress:
        moved = manner.sign * share * manner.travel
        T_asset_ee = hold.T_asset_ee.copy()
        T_asset_ee[:3, 3] += manner.slip_m * (share - 0.5) * asset.handle_axis
        T_held = asset.joint.motion(manner.start + moved) @ T_asset_ee
        if asset.joint.type == "revolute":
            lag = matrix_from_rotvec(-(1.0 - manner.follow) * moved * asset.joint.axis)
            T_held = transform(lag @ T_held[:3, :3], T_held[:3, 3])
        poses.append(T_held)
    return np.array(poses)


def hand_axes(robot: RobotModel) -> Array:
    """Axes (3, 3) of the hand in the end effector's frame: width of the fingers, closing, approach."""
    width = np.cross(robot.closing_ee, robot.approach_ee)
    return np.array([width, robot.closing_ee, robot.approach_ee], np.float64).T


def front_normal(asset: ArticulatedAsset) -> Array:
    """Unit normal (3,) of the front that the handle stands off from, asset frame.

    It is not always the way of the first motion: a lid is held from its front and lifted. A handle
    without a part behind it is taken along its first motion.
    """
    foot = handle_foot(asset)
    if foot is None:
        return outward_normal(asset)
    away = asset.handle_point - foot
    away = away - (away @ asset.handle_axis) * asset.handle_axis
    return np.asarray(away / np.linalg.norm(away), np.float64)


def handle_foot(asset: ArticulatedAsset) -> Array | None:
    """The nearest point (3,) of the part behind its handle; None where handle and part are one."""
    feet = []
    for box in asset.moving.colliders:
        if not box.name.startswith("handle"):
            local = apply(invert(box.T_asset_box), asset.handle_point)
            feet.append(apply(box.T_asset_box, np.clip(local, -box.half_extents, box.half_extents)))
    if asset.handle_bar is None or not feet:
        return None
    distances = np.linalg.norm(np.array(feet) - asset.handle_point, axis=1)
    nearest = int(np.argmin(distances))
    return feet[nearest] if distances[nearest] > 1e-3 else None
