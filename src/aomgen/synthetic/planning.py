"""How the robot of a synthetic capture opens the object: grasp, path, timing."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from aomgen.assets.check import outward_normal
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.core.values import Array, freeze
from aomgen.physics.robot import RobotModel
from aomgen.synthetic.inverse import Arm
from aomgen.synthetic.setting import Setting, World

# Seconds of each phase: rest, reach, approach, close, open the object, release, retreat, rest.
PHASES_S = (1.0, 1.8, 1.0, 0.7, 3.0, 0.6, 0.9, 0.5)
CONTROL_STEP_S = 0.002
PREGRASP_M = 0.09
MAX_KNOT_STEP_RAD = 0.20
SEEDS = 14
# Where solutions are looked for first, [rad]; elsewhere anywhere within the limits.
POSTURES = {
    "ur5e_2f85": ([-np.pi, -2.4, 0.8, -2.5, -2.6, -np.pi], [np.pi, -0.7, 2.5, 1.0, 2.6, np.pi]),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Script:
    """What the robot is told to do.

    Attributes:
        times_s: (T,), every CONTROL_STEP_S from 0.
        joints: Desired joints (T, J), [rad].
        gripper: Commanded closing (T,), 0..1.
        theta_goal: Joint value the object should reach, [rad] or [m].
    """

    times_s: Array
    joints: Array
    gripper: Array
    theta_goal: float

    def __post_init__(self) -> None:
        for name in ("times_s", "gripper"):
            freeze(self, name, getattr(self, name), (None,))
        freeze(self, "joints", self.joints, (len(self.times_s), None))


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspStyle:
    """How the hand holds the handle and follows it.

    Attributes:
        flip: Whether the fingers are exchanged.
        tilt_rad: Downward tilt of the approach direction.
        follow: Share of the object's turn that the hand turns with, 0..1.
        theta_goal: Joint value to reach.
    """

    flip: bool
    tilt_rad: float
    follow: float
    theta_goal: float


def draw_style(setting: Setting, rng: np.random.Generator) -> GraspStyle:
    """A random way to open the object, far enough to be a demonstration."""
    upper = setting.asset.joint.upper
    if setting.asset.joint.type == "revolute":
        goal = min(np.deg2rad(rng.uniform(48, 70)), 0.8 * upper)
    else:
        goal = min(rng.uniform(0.15, 0.22), 0.9 * upper)
    tilt = np.deg2rad(rng.uniform(4, 24))
    return GraspStyle(
        flip=bool(rng.random() < 0.5), tilt_rad=tilt, follow=rng.uniform(0.6, 1.0), theta_goal=float(goal)
    )


def grasp_poses(robot: RobotModel, setting: Setting, style: GraspStyle, thetas: ArrayLike) -> Array:
    """Poses T_world_ee (N, 4, 4) of the hand while the object's joint has the given values.

    The hand approaches the front, and its fingers close across the handle's bar.
    """
    asset = setting.asset
    approach = -outward_normal(asset)
    along = asset.handle_axis * (-1.0 if style.flip else 1.0)
    R = np.stack([along, np.cross(approach, along), approach], 1)
    # The hand comes from above: turn about the horizontal axis of the front, right of approach.
    sideways = np.cross(approach, [0.0, 0.0, 1.0])
    R_ee_hand = np.stack(
        [np.cross(robot.closing_ee, robot.approach_ee), robot.closing_ee, robot.approach_ee], 1
    )
    R = matrix_from_rotvec(-style.tilt_rad * sideways) @ R @ R_ee_hand.T
    T_asset_grasp = transform(R, asset.handle_point)
    poses = []
    for theta in np.asarray(thetas, np.float64):
        T_held = asset.joint.motion(theta) @ T_asset_grasp
        if asset.joint.type == "revolute":
            lag = matrix_from_rotvec(-(1.0 - style.follow) * theta * asset.joint.axis)
            T_held = transform(lag @ T_held[:3, :3], T_held[:3, 3])
        poses.append(setting.T_world_object @ T_held)
    return np.array(poses)


def plan(robot: RobotModel, world: World, setting: Setting, rng: np.random.Generator) -> Script | None:
    """Joint path and timing of one demonstration; None where this setting and style cannot be reached.

    Checked: residuals, joint steps, contact of anything but the fingers with handle. Not
    checked: dynamics (see `demonstration.py`).
    """
    style = draw_style(setting, rng)
    arm = Arm(world.model, robot)
    thetas = np.linspace(0.0, style.theta_goal, 40)
    held = grasp_poses(robot, setting, style, thetas)
    approach_ee = robot.approach_ee
    before = _withdrawn(held[0], approach_ee, np.linspace(PREGRASP_M, 0.0, 10))
    after = _withdrawn(held[-1], approach_ee, np.linspace(0.0, PREGRASP_M, 10))
    low, high = POSTURES.get(robot.name, np.clip(robot.joint_limits, -np.pi, np.pi).T)
    for _ in range(SEEDS):
        start = rng.uniform(low, high)
        grasp = arm.solve(held[0], start)
        if not grasp.exact:
            continue
        approach = _tracked(arm, before[::-1], grasp.joints)
        opening = _tracked(arm, held, grasp.joints)
        if approach is None or opening is None:
            continue
        retreat = _tracked(arm, after, opening[-1])
        rest = _rest(arm, setting, before[0], approach_ee, approach[-1], rng)
        if retreat is None or rest is None:
            continue
        approach = approach[::-1]
        reach = rest + np.linspace(0, 1, 12)[:, None] * (approach[0] - rest)
        if not _free(robot, world, [*reach, *approach, *retreat], 0.0) or not _free(
            robot, world, opening, 0.6, style, thetas
        ):
            continue
        return _timed(rest, approach, opening, retreat, style)
    return None


def _withdrawn(T_world_ee: Array, approach_ee: Array, distances: ArrayLike) -> Array:
    """The pose moved back along its approach direction by each distance, [m]."""
    distances = np.asarray(distances, np.float64)
    poses = np.repeat(T_world_ee[None], len(distances), 0)
    poses[:, :3, 3] -= distances[:, None] * (T_world_ee[:3, :3] @ approach_ee)
    return poses


def _tracked(arm: Arm, poses: Array, start: Array) -> Array | None:
    """Joints (N, J) along poses without jumps; None where they leave the reach."""
    path, joints = [], start
    for T in poses:
        reach = arm.solve(T, joints, iterations=25)
        if not reach.exact or np.abs(reach.joints - joints).max() > MAX_KNOT_STEP_RAD:
            return None
        joints = reach.joints
        path.append(joints)
    return np.array(path)


def _rest(
    arm: Arm,
    setting: Setting,
    T_world_pregrasp: Array,
    approach_ee: Array,
    near: Array,
    rng: np.random.Generator,
) -> Array | None:
    """Joints at rest: the hand drawn back towards the robot, higher, looking down a little."""
    T = T_world_pregrasp.copy()
    T[:2, 3] *= rng.uniform(0.55, 0.75)
    T[2, 3] = max(T[2, 3], setting.room.table_z + 0.15) + rng.uniform(0.10, 0.22)
    sideways = np.cross(T[:3, :3] @ approach_ee, [0.0, 0.0, 1.0])
    T[:3, :3] = matrix_from_rotvec(-np.deg2rad(rng.uniform(15, 40)) * sideways) @ T[:3, :3]
    reach = arm.solve(T, near)
    if not reach.exact or np.abs(reach.joints - near).max() > 1.8:
        return None
    return reach.joints


def _free(
    robot: RobotModel,
    world: World,
    path: Sequence[Array] | Array,
    gripper: float,
    style: GraspStyle | None = None,
    thetas: ArrayLike | None = None,
) -> bool:
    """Whether the arm touches nothing along a path; with `style`, the hand may touch the moving part."""
    model = world.model
    data = mujoco.MjData(model)
    values = np.zeros(len(path)) if thetas is None else np.asarray(thetas, np.float64)
    robot_size = len(robot.qpos(path[0], 0.0)[0])
    for index in range(0, len(path), 2):
        data.qpos[:robot_size] = robot.qpos(path[index], gripper)[0]
        data.joint(world.names.joint).qpos[0] = values[index]
        mujoco.mj_forward(model, data)
        for contact in data.contact:
            if contact.dist < 0 and not _allowed(robot, model, contact.geom, world, style is not None):
                return False
    return True


def _allowed(robot: RobotModel, model: mujoco.MjModel, geoms: Array, world: World, holding: bool) -> bool:
    bodies = [model.body(model.geom_bodyid[g]).name for g in geoms]
    ours = [name in robot.body_names for name in bodies]
    if not any(ours):
        return True
    hand = [name in robot.hand_bodies for name in bodies]
    if all(ours):
        return all(hand)
    other = bodies[0] if ours[1] else bodies[1]
    return holding and any(hand) and other == world.names.moving_body


def _timed(rest: Array, approach: Array, opening: Array, retreat: Array, style: GraspStyle) -> Script:
    """Minimum-jerk timing of every phase."""
    still_before, still_after = np.repeat(approach[-1:], 2, 0), np.repeat(opening[-1:], 2, 0)
    paths = [
        np.repeat(rest[None], 2, 0), np.stack([rest, approach[0]]), approach, still_before,
        opening, still_after, retreat, np.repeat(retreat[-1:], 2, 0),
    ]  # fmt: skip
    grips = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0), (0.0, 0.0)]
    joints, gripper = [], []
    for path, (first, last), seconds in zip(paths, grips, PHASES_S, strict=True):
        count = round(seconds / CONTROL_STEP_S)
        share = _minimum_jerk(np.arange(count) / count)
        joints.append(CubicSpline(np.linspace(0, 1, len(path)), path)(share) if len(path) > 2 else
                      path[0] + share[:, None] * (path[1] - path[0]))  # fmt: skip
        gripper.append(first + (last - first) * np.clip(np.arange(count) / (0.7 * count), 0, 1))
    joints.append(retreat[-1:])
    gripper.append(np.zeros(1))
    stacked = np.concatenate(joints)
    return Script(
        times_s=np.arange(len(stacked), dtype=np.float64) * CONTROL_STEP_S,
        joints=stacked,
        gripper=np.concatenate(gripper),
        theta_goal=style.theta_goal,
    )


def _minimum_jerk(u: Array) -> Array:
    """Smooth progress 0..1. Source: Flash and Hogan, 1985."""
    return u**3 * (10 - 15 * u + 6 * u**2)
