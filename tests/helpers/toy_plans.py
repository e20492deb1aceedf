"""Plans that open or close a drawer, a microwave or a sliding cabinet; the end effector starts at the handle."""

import numpy as np

from aomgen.assets.choice import make_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.demonstration import SupportPlane
from aomgen.core.plan import EpisodePlan, FittedAsset, Variation
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.episodes.ik import ik_solver, solve_path
from aomgen.episodes.joint_limits import IkLimits
from aomgen.robots.robot import RobotModel

SUPPORT = SupportPlane(height=0.05, low_xy=[-np.inf] * 2, high_xy=[np.inf] * 2)
NEAR = np.array([2.11, -1.51, 2.26, -0.75, 0.53, 1.57])
# Out of the palm along +x of the world; fingers close up and down, or left and right.
UP_DOWN = np.stack([np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])], 1)
LEFT_RIGHT = np.stack([np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])], 1)
FRAMES = 46


def facing_robot(
    asset: ArticulatedAsset, handle_world: tuple[float, float], height: float = 0.05
) -> np.ndarray:
    """Compute the pose (4, 4) of an asset whose front faces the robot and whose handle is above a point."""
    R = matrix_from_rotvec(np.array([0, 0, -np.pi / 2]))
    held = R @ asset.handle_point
    return transform(R, np.array([handle_world[0] - held[0], handle_world[1] - held[1], height]))


def pulled(target: float) -> np.ndarray:
    """Compute the joint values of all frames: ten to close the gripper, 26 to open the part, ten to release it."""
    u = np.linspace(0, 1, 26)
    return target * np.concatenate([np.zeros(10), u * u * (3 - 2 * u), np.ones(10)])


def toy_plan(
    robot: RobotModel,
    asset: ArticulatedAsset,
    T_world_object: np.ndarray,
    R_world_ee: np.ndarray,
    thetas: np.ndarray,
    *,
    turn: float = 1.0,
    offset_ee: tuple[float, float, float] = (0.0, 0.0, 0.0),
    closed: float = 1.0,
) -> EpisodePlan:
    """Plan an end effector path that follows the handle of a part with joint values `thetas`.

    Args:
        turn: Rotation of the end effector over that of the part.
        offset_ee: Offset of the end effector from the handle, end-effector frame, [m].
        closed: Gripper value before the hold; 0 is open.
    """
    joint = asset.joint.move(T_world_object)
    held = apply(T_world_object, asset.handle_point)
    points = np.array([apply(joint.motion(theta), held) for theta in thetas])
    turns = np.zeros(len(thetas)) if joint.type == "prismatic" else turn * thetas
    Rs = np.array([matrix_from_rotvec(angle * joint.axis) @ R_world_ee for angle in turns])
    poses = transform(Rs, points + Rs @ np.array(offset_ee))
    path = solve_path(ik_solver(robot), np.concatenate([poses[:1], poses]), NEAR, IkLimits(iterations=60))
    assert isinstance(path, np.ndarray), path
    fitted = FittedAsset(
        asset=asset,
        T_world_asset=T_world_object,
        contact_asset=asset.handle_point,
        shares=np.linspace(0, 1, len(thetas)),
        thetas=thetas,
        scale=1.0,
        mirrored=False,
        mode="trajectory",
        residual_mm=0.0,
    )
    return EpisodePlan(
        variation=Variation(seed=0, index=0, x=0, y=0, yaw=0),
        fitted=fitted,
        T_world_object=T_world_object,
        fps=10,
        times_s=np.arange(len(thetas)) / 10,
        joints=path[1:],
        gripper=np.interp(np.arange(len(thetas)), [2, 6, 40, 44], [1 - closed, 1, 1, 1 - closed]),
        thetas=thetas,
        phases=np.ones(len(thetas)),
        Ts_world_ee=poses,
        grasp="test",
        metrics={"penetration_mm": 0.0, "grip_gap_mm": 1.0},
    )


def drawer_plan(robot: RobotModel, *, closing: bool = False) -> EpisodePlan:
    """Close the gripper on the bar of a drawer, pull 0.15 m or push an open one shut, and release it."""
    asset = make_asset("drawer", 1)
    T = transform(matrix_from_rotvec(np.array([0, 0, -np.pi / 2])), np.array([0.92, -0.2, 0.05]))
    return toy_plan(robot, asset, T, UP_DOWN, pulled(0.15)[:: -1 if closing else 1])


def microwave_plan(robot: RobotModel, *, closing: bool = False) -> EpisodePlan:
    """Close the gripper on the bar of a microwave's door, turn it by 40 degrees, open or shut, and release it."""
    asset = make_asset("microwave", 1)
    T = facing_robot(asset, (0.62, -0.15))
    thetas = pulled(np.deg2rad(40.0))[:: -1 if closing else 1]
    return toy_plan(robot, asset, T, LEFT_RIGHT, thetas, turn=0.7)
