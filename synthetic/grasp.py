"""Grasp of a part: how the gripper holds, its pose as the part moves, the size of its closed tips."""

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays
from aomgen.robots.robot import RobotModel
from synthetic.style import DemonstrationStyle

# A hooking or pushing bar lies this far behind the finger tips, [m]: half a finger pad.
BAR_BEHIND_TIP_M: Final = 0.010
_CORNERS: Final = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, -1).T


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspStyle:
    """Details of a grasp that a style leaves open.

    Attributes:
        flip: Whether the fingers are exchanged.
        tilt_rad: Downward tilt of the approach direction.
        side: -1 or 1: from which side the gripper hooks, or on which side of the bar it pushes.
        slant_rad: Angle between a hooking gripper and the front's normal.
        beside_m: Distance from the bar at which a gripper pushes on the front.
    """

    flip: bool
    tilt_rad: float
    side: float = 1.0
    slant_rad: float = 0.0
    beside_m: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DemonstratedGrasp:
    """The gripper on the part, asset frame at joint value 0.

    Attributes:
        T_asset_ee: Pose of the end effector in touch with the part.
        pivot: Point about which the end effector turns when it turns less than the part, [m].
        slack: Way back to where it does not touch yet, [m]; zero for fingers that close.
        gripper: Closing before and while it holds, 0..1.
    """

    T_asset_ee: Matrix4
    pivot: Vector3
    slack: Vector3
    gripper: tuple[float, float]

    __post_init__ = freeze_arrays


def draw_grasp_style(rng: np.random.Generator, style: DemonstrationStyle) -> GraspStyle:
    """Sample the details that the style leaves open."""
    tilt, flip = np.deg2rad(rng.uniform(4, 24)), bool(rng.random() < 0.5)
    if style.touch == "pinch":
        return GraspStyle(flip=flip, tilt_rad=tilt)
    return GraspStyle(
        flip=flip,
        tilt_rad=tilt,
        side=float(rng.choice([-1.0, 1.0])),
        slant_rad=np.deg2rad(rng.uniform(48, 66)),
        beside_m=rng.uniform(0.035, 0.09),
    )


def measure_closed_tips(robot: RobotModel, model: mujoco.MjModel) -> Array:
    """Low and high corner (2, 3) of the closed finger tips: width, closing, approach from the end effector, [m].

    Of the bodies that carry the pads and their neighbors, what lies beyond the end effector.
    """
    data = mujoco.MjData(model)
    middle = np.clip(robot.joint_limits, -np.pi, np.pi).mean(1)
    rest = robot.qpos(middle, 1.0)[0]
    data.qpos[: len(rest)] = rest
    mujoco.mj_kinematics(model, data)
    site = model.site(robot.ee_site).id
    axes = data.site_xmat[site].reshape(3, 3) @ gripper_axes(robot)
    hand = {model.body(name).id for name in robot.hand_bodies}
    found = []
    for geom in range(model.ngeom):
        if int(model.geom_bodyid[geom]) in hand and model.geom_contype[geom] | model.geom_conaffinity[geom]:
            middle_geom, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            corners = middle_geom + _CORNERS * half
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
                mesh = int(model.geom_dataid[geom])
                first = int(model.mesh_vertadr[mesh])
                corners = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]
            world = corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            found.append((world - data.site_xpos[site]) @ axes)
    points = np.concatenate(found)
    tips = points[points[:, 2] > points[:, 2].max() - 2 * BAR_BEHIND_TIP_M]
    return np.array([tips.min(0), tips.max(0)])


def compute_grasp_poses(
    asset: ArticulatedAsset, grasp: DemonstratedGrasp, style: DemonstrationStyle, progress: ArrayLike
) -> Array:
    """Poses (N, 4, 4) of the end effector in the asset frame after shares (N,) of the part's travel.

    It turns with its share of the part's turn, and slides along the bar as the style says.
    """
    progress = np.asarray(progress, np.float64)
    poses = []
    for share in progress:
        moved = style.sign * share * style.travel
        slip = style.slip_m * (share - 0.5) * asset.handle_axis
        T_asset_ee = grasp.T_asset_ee.copy()
        T_asset_ee[:3, 3] += slip
        T_moved = asset.joint.motion(style.start + moved)
        T_held = T_moved @ T_asset_ee
        if asset.joint.type == "revolute":
            lag = matrix_from_rotvec(-(1.0 - style.follow) * moved * asset.joint.axis)
            pivot = apply(T_moved, grasp.pivot + slip)
            T_held = transform(lag @ T_held[:3, :3], pivot + lag @ (T_held[:3, 3] - pivot))
        poses.append(T_held)
    return np.array(poses)


def gripper_axes(robot: RobotModel) -> Array:
    """Axes (3, 3) of the gripper in the end effector's frame: width of the fingers, closing, approach."""
    width = np.cross(robot.closing_ee, robot.approach_ee)
    return np.array([width, robot.closing_ee, robot.approach_ee], np.float64).T
