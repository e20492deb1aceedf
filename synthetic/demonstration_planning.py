"""Plan of the robot's motion in a synthetic capture: grasp, joint path, allowed contacts."""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.transforms import matrix_from_rotvec, rotvec_from_matrix
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import Scene
from synthetic.commanded_trajectory import CommandedTrajectory, PhasePaths, time_phases
from synthetic.grasp import DemonstratedGrasp, compute_grasp_poses, draw_grasp_style
from synthetic.grasp_selection import choose_grasp, draw_usual_style
from synthetic.layout import SceneLayout
from synthetic.style import DemonstrationStyle

# The end effector approaches on a straight line of this length, [m]: longer than fingers are. Gestures in the air stay
# the second length before the handle.
PREGRASP_M, AIR_M = 0.09, 0.12
# Joints that jump by more from knot to knot have changed their branch, [rad].
MAX_KNOT_STEP_RAD = 0.20
KNOTS, REACH_KNOTS, SLACK_KNOTS = 40, 10, 4
# Closing of the gripper with which a pinch is checked, and the depth that a pressing gripper may seem to be, [m].
PINCHING, PRESS_M = 0.6, 0.003
# Starts of the inverse kinematics that are tried before a layout is given up. They end in few different
# configurations; the same one, [rad], is not followed twice.
SEEDS, SAME_RAD = 14, 0.02
# Damping of the least squares: small against squared lever arms of 0.1 to 1 m, large against rounding. Largest
# change of a joint in one step, [rad]: the linear model holds that far.
DAMPING, MAX_STEP_RAD = 1e-4, 0.25
# Joint values where solutions are searched first, [rad]; then anywhere within the limits.
CONFIGURATIONS = {
    "ur5e_2f85": ([-np.pi, -2.4, 0.8, -2.5, -2.6, -np.pi], [np.pi, -0.7, 2.5, 1.0, 2.6, np.pi]),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class IkSolution:
    """Joints (J,), [rad] or [m], and what is left to the target: [m] and [rad]."""

    joints: Array
    position_error: float
    rotation_error: float

    @property
    def exact(self) -> bool:
        """Return whether the target is met within 0.5 mm and 0.2 degrees."""
        return self.position_error < 5e-4 and self.rotation_error < np.deg2rad(0.2)


class ArmKinematics:
    """Scratch kinematics of the arm inside a compiled model; not thread safe."""

    def __init__(self, scene: Scene) -> None:
        self._model, self._data = scene.model, mujoco.MjData(scene.model)
        self._arm, self._site = scene.arm, scene.ee_site
        self._limits = scene.robot.joint_limits

    def solve(self, T_world_ee: Array, start: Array, *, iterations: int = 60) -> IkSolution:
        """Joints that bring the end effector site to a pose (4, 4), near `start` (J,)."""
        joints = np.array(start, np.float64)
        position, turn = self._errors(T_world_ee, joints)
        for _ in range(iterations):
            if np.linalg.norm(position) < 1e-5 and np.linalg.norm(turn) < 1e-5:
                break
            J = np.zeros((6, self._model.nv))
            mujoco.mj_jacSite(self._model, self._data, J[:3], J[3:], self._site)
            J = J[:, self._arm.dofs]
            error = np.concatenate([position, turn])
            step = J.T @ np.linalg.solve(J @ J.T + DAMPING * np.eye(6), error)
            step *= min(1.0, MAX_STEP_RAD / max(float(np.abs(step).max()), 1e-12))
            joints = np.clip(joints + step, self._limits[:, 0], self._limits[:, 1])
            position, turn = self._errors(T_world_ee, joints)
        return IkSolution(
            joints=joints,
            position_error=float(np.linalg.norm(position)),
            rotation_error=float(np.linalg.norm(turn)),
        )

    def _errors(self, T_world_ee: Array, joints: Array) -> tuple[Array, Array]:
        self._data.qpos[self._arm.qpos] = joints
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        R = self._data.site_xmat[self._site].reshape(3, 3)
        position = T_world_ee[:3, 3] - self._data.site_xpos[self._site]
        return position, rotvec_from_matrix(T_world_ee[:3, :3] @ R.T)


def plan(
    scene: Scene,
    layout: SceneLayout,
    rng: np.random.Generator,
    style: DemonstrationStyle | None = None,
) -> tuple[DemonstrationStyle, CommandedTrajectory] | None:
    """Joint path and timing of one demonstration; None where this layout and style cannot be reached.

    Without a style it is the usual pinch that opens the object. Checked: residuals, joint steps, contact of
    anything but the fingers with handle. Not checked: dynamics (see `demonstration_search.simulate`).
    """
    robot, asset = scene.robot, layout.asset
    style, grasp_style = (style, draw_grasp_style(rng, style)) if style else draw_usual_style(asset, rng)
    grasp = choose_grasp(robot, scene.model, asset, grasp_style, style)
    if grasp is None:
        return None
    arm = ArmKinematics(scene)
    path = _hand_path(robot, layout, grasp, style)
    low, high = CONFIGURATIONS.get(robot.name, np.clip(robot.joint_limits, -np.pi, np.pi).T)
    dead_ends: list[Array] = []
    for _ in range(SEEDS):
        start = rng.uniform(low, high)
        first = arm.solve(path.motion[0], start)
        if not first.exact or any(np.abs(first.joints - other).max() < SAME_RAD for other in dead_ends):
            continue
        motion = _tracked(arm, path.motion, first.joints)
        to = None if motion is None else _tracked(arm, path.approach[::-1], first.joints)
        if to is None or motion is None:
            dead_ends.append(first.joints)
            continue
        off = _tracked(arm, path.retreat, motion[-1])
        rest = _rest(arm, layout, path.approach[0], robot.approach_ee, to[-1], rng)
        if off is None or rest is None:
            continue
        way = _way(rest, to[::-1], motion, off, grasp)
        if _is_free(scene, way, style):
            return style, time_phases(way, style)
    return None


@dataclass(frozen=True, slots=True, kw_only=True)
class _HandPath:
    """Poses T_world_ee (N, 4, 4) before, during and after the motion."""

    approach: Array
    motion: Array
    retreat: Array


def _hand_path(
    robot: RobotModel, layout: SceneLayout, grasp: DemonstratedGrasp, style: DemonstrationStyle
) -> _HandPath:
    """Poses of the end effector; one whose gripper does not close comes off the part by its slack before it leaves."""
    asset = layout.asset
    shares = np.zeros(KNOTS) if style.outcome == "touch" else np.linspace(0.0, 1.0, KNOTS)
    held = layout.T_world_object @ compute_grasp_poses(asset, grasp, style, shares)
    if style.outcome == "nothing":
        # The whole motion is made in the air before the part.
        held = np.array([_withdrawn(T, robot.approach_ee, [AIR_M])[0] for T in held])
    near, last = held[0], held[-1]
    before, after = [], []
    if grasp.slack.any():
        values = [style.start, style.start if style.outcome == "touch" else style.goal]
        R = (layout.T_world_object @ asset.joint.motion(values))[:, :3, :3]
        steps = np.linspace(1.0, 0.0, SLACK_KNOTS)
        before = [_shifted(near, share * R[0] @ grasp.slack) for share in steps]
        after = [_shifted(last, share * R[1] @ grasp.slack) for share in steps[::-1]]
        near, last = before[0], after[-1]
    away = _withdrawn(near, robot.approach_ee, np.linspace(PREGRASP_M, 0.0, REACH_KNOTS))
    back = _withdrawn(last, robot.approach_ee, np.linspace(0.0, PREGRASP_M, REACH_KNOTS))
    return _HandPath(
        approach=np.array([*away, *before[1:]]), motion=held, retreat=np.array([*after[:-1], *back])
    )


def _way(rest: Array, to: Array, motion: Array, off: Array, grasp: DemonstratedGrasp) -> PhasePaths:
    """Joints of all phases; what lies before and after `REACH_KNOTS` is slack."""
    touching, leaving = to[REACH_KNOTS - 1 :], off[: len(off) - REACH_KNOTS + 1]
    return PhasePaths(
        rest=rest,
        approach=to[:REACH_KNOTS],
        hold=touching if len(touching) > 1 else np.repeat(touching, 2, 0),
        motion=motion,
        release=leaving if len(leaving) > 1 else np.repeat(motion[-1:], 2, 0),
        retreat=off[len(off) - REACH_KNOTS :],
        gripper=grasp.gripper,
    )


def _is_free(scene: Scene, way: PhasePaths, style: DemonstrationStyle) -> bool:
    """Return whether the arm touches nothing on its path but, while it holds, the part with its gripper."""
    still = style.outcome in ("touch", "nothing")
    values = np.linspace(style.start, style.start if still else style.goal, KNOTS)
    reach = way.rest + np.linspace(0, 1, 12)[:, None] * (way.approach[0] - way.rest)
    away, held = way.gripper
    held, deepest = (max(PINCHING, away), np.inf) if style.touch == "pinch" else (held, PRESS_M)
    return (
        _is_path_free(scene, np.array([*reach, *way.approach]), away, values[:1])
        and _is_path_free(scene, way.retreat, away, values[-1:])
        and _is_path_free(scene, way.motion, held, values, deepest=deepest)
    )


def _is_path_free(
    scene: Scene, path: Array, gripper: float, values: ArrayLike, *, deepest: float = 0.0
) -> bool:
    """Return whether the robot touches nothing along joints (N, J), [rad]; the gripper may reach into the part by a depth, [m].

    Joint values of the part: (N,), or one for all (1,).
    """
    roles, data = scene.roles, mujoco.MjData(scene.model)
    for qpos in scene.qpos(path, gripper, values)[::2]:
        data.qpos[:] = qpos
        mujoco.mj_forward(scene.model, data)
        (a, b), depth = data.contact.geom.T, -data.contact.dist
        within = roles.gripper[a] & roles.gripper[b]
        on_part = (roles.gripper[a] & roles.moving[b]) | (roles.moving[a] & roles.gripper[b])
        allowed = np.where(roles.robot[a] & roles.robot[b], within, on_part & (depth < deepest))
        if ((depth > 0) & (roles.robot[a] | roles.robot[b]) & ~allowed).any():
            return False
    return True


def _shifted(T_world_ee: Array, way: Array) -> Array:
    T = T_world_ee.copy()
    T[:3, 3] += way
    return T


def _withdrawn(T_world_ee: Array, approach_ee: Array, distances: ArrayLike) -> Array:
    """The pose moved back along its approach direction by each distance, [m]."""
    distances = np.asarray(distances, np.float64)
    poses = np.repeat(T_world_ee[None], len(distances), 0)
    poses[:, :3, 3] -= distances[:, None] * (T_world_ee[:3, :3] @ approach_ee)
    return poses


def _tracked(arm: ArmKinematics, poses: Array, start: Array) -> Array | None:
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
    arm: ArmKinematics,
    layout: SceneLayout,
    T_world_pregrasp: Array,
    approach_ee: Array,
    near: Array,
    rng: np.random.Generator,
) -> Array | None:
    """Joints at rest: the end effector drawn back towards the robot, higher, looking down a little."""
    T = T_world_pregrasp.copy()
    T[:2, 3] *= rng.uniform(0.55, 0.75)
    T[2, 3] = max(T[2, 3], layout.room.table_z + 0.15) + rng.uniform(0.10, 0.22)
    approach = T[:3, :3] @ approach_ee
    down = np.deg2rad(rng.uniform(15, 40)) + max(float(np.arcsin(np.clip(approach[2], -1, 1))), 0.0)
    T[:3, :3] = matrix_from_rotvec(-down * np.cross(approach, [0.0, 0.0, 1.0])) @ T[:3, :3]
    reach = arm.solve(T, near)
    if not reach.exact or np.abs(reach.joints - near).max() > 1.8:
        return None
    return reach.joints
