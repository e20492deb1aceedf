"""How the robot of a synthetic capture moves the object: grasp, joint path, what it may touch."""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.transforms import matrix_from_rotvec
from aomgen.core.values import Array
from aomgen.physics.robot import RobotModel
from aomgen.synthetic.grasp import draw_style, hold_poses, pinch, usual
from aomgen.synthetic.inverse import Arm
from aomgen.synthetic.manner import Manner
from aomgen.synthetic.setting import Setting, World
from aomgen.synthetic.timing import Script, Way, timed

PREGRASP_M = 0.09
MAX_KNOT_STEP_RAD = 0.20
KNOTS = 40
SEEDS = 14
# Where solutions are looked for first, [rad]; elsewhere anywhere within the limits.
POSTURES = {
    "ur5e_2f85": ([-np.pi, -2.4, 0.8, -2.5, -2.6, -np.pi], [np.pi, -0.7, 2.5, 1.0, 2.6, np.pi]),
}


def plan(
    robot: RobotModel,
    world: World,
    setting: Setting,
    rng: np.random.Generator,
    manner: Manner | None = None,
) -> tuple[Manner, Script] | None:
    """Joint path and timing of one demonstration; None where this setting and style cannot be reached.

    Args:
        manner: How it is done; the usual pinch that opens the object when None.

    Checked: residuals, joint steps, contact of anything but the fingers with handle. Not
    checked: dynamics (see `demonstration.py`).
    """
    asset = setting.asset
    manner, style = (manner, draw_style(rng, manner)) if manner else usual(asset, rng)
    hold = pinch(robot, asset, style)
    arm = Arm(world.model, robot)
    progress = np.linspace(0.0, 1.0, KNOTS)
    held = setting.T_world_object @ hold_poses(asset, hold, manner, progress)
    before = _withdrawn(held[0], robot.approach_ee, np.linspace(PREGRASP_M, 0.0, 10))
    after = _withdrawn(held[-1], robot.approach_ee, np.linspace(0.0, PREGRASP_M, 10))
    low, high = POSTURES.get(robot.name, np.clip(robot.joint_limits, -np.pi, np.pi).T)
    values = manner.start + manner.sign * manner.travel * progress
    for _ in range(SEEDS):
        start = rng.uniform(low, high)
        grasp = arm.solve(held[0], start)
        if not grasp.exact:
            continue
        approach = _tracked(arm, before[::-1], grasp.joints)
        motion = _tracked(arm, held, grasp.joints)
        if approach is None or motion is None:
            continue
        retreat = _tracked(arm, after, motion[-1])
        rest = _rest(arm, setting, before[0], robot.approach_ee, approach[-1], rng)
        if retreat is None or rest is None:
            continue
        approach = approach[::-1]
        reach = rest + np.linspace(0, 1, 12)[:, None] * (approach[0] - rest)
        away = _Free(robot, world, gripper=hold.gripper[0], touching=False)
        holding = _Free(robot, world, gripper=0.6, touching=True)
        if not (
            away.along([*reach, *approach], values[:1])
            and away.along(retreat, values[-1:])
            and holding.along(motion, values)
        ):
            continue
        way = Way(
            rest=rest,
            approach=approach,
            hold=np.repeat(approach[-1:], 2, 0),
            motion=motion,
            release=np.repeat(motion[-1:], 2, 0),
            retreat=retreat,
            gripper=hold.gripper,
        )
        return manner, timed(way, manner)
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


class _Free:
    """Tells whether the arm touches nothing along a path."""

    def __init__(self, robot: RobotModel, world: World, *, gripper: float, touching: bool) -> None:
        """With `touching` the hand may touch the moving part."""
        self._robot, self._model, self._gripper = robot, world.model, gripper
        self._joint = world.names.joint
        bodies = [world.model.body(b).name for b in world.model.geom_bodyid]
        self._ours = np.array([name in robot.body_names for name in bodies])
        self._hand = np.array([name in robot.hand_bodies for name in bodies])
        self._part = np.array([touching and name == world.names.moving_body for name in bodies])

    def along(self, path: Sequence[Array] | Array, values: ArrayLike) -> bool:
        """Joints (N, J) and the part's joint values (N,), or one for all."""
        data = mujoco.MjData(self._model)
        values = np.broadcast_to(np.asarray(values, np.float64), len(path))
        size = len(self._robot.qpos(path[0], 0.0)[0])
        for index in range(0, len(path), 2):
            data.qpos[:size] = self._robot.qpos(path[index], self._gripper)[0]
            data.joint(self._joint).qpos[0] = values[index]
            mujoco.mj_forward(self._model, data)
            geoms = data.contact.geom[data.contact.dist < 0]
            if not all(self._allowed(a, b) for a, b in geoms):
                return False
        return True

    def _allowed(self, a: int, b: int) -> bool:
        if not (self._ours[a] or self._ours[b]):
            return True
        if self._ours[a] and self._ours[b]:
            return bool(self._hand[a] and self._hand[b])
        ours, other = (a, b) if self._ours[a] else (b, a)
        return bool(self._hand[ours] and self._part[other])
