"""Test whether an arm can hold a handle along the part's motion, without the planner's code.

Refusals of the planner are errors where this test succeeds.
"""

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from aomgen.assets.asset_check import outward_normal
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import apply, matrix_from_rotvec, rotvec_from_matrix, transform
from aomgen.core.values import Array
from aomgen.simulation.collision_check import holding_gripper
from aomgen.simulation.scene import Scene

# Random arms and grasps tried: flat laptops, the hardest, need some hundred where they are feasible at all.
RESTARTS: Final = 400
# The gripper may be tilted up or down from the front's normal by this angle, about the handle, while it
# holds, [rad], as with human operators.
LEAN_RAD: Final = np.deg2rad(50.0)
# Positions of the bar between the pads, from the end effector towards the tips, [m].
DEPTHS_M: Final = (-0.005, 0.012)
# Samples along the contact, and damped steps: first from a random start, then from the previous sample.
SAMPLES, FIRST_STEPS, NEXT_STEPS = 24, 60, 10
# Least squares damping, and largest step of a joint, [rad]: a random start is far away.
DAMPING, LONGEST_STEP_RAD = 1e-3, 0.5
# Errors within which a pose counts as reached: [m] and [rad].
REACHED_M, REACHED_RAD = 0.001, np.deg2rad(0.5)
# A larger rotation of a joint between samples is a change of the branch, [rad].
BRANCH_RAD: Final = 0.6
# Deeper overlap is a collision, [m]; the robot's own colliders overlap in its start pose already.
OVERLAP_M: Final = 0.001


def can_hold(
    scene: Scene,
    fitted: FittedAsset,
    start_joints: Array,
    rng: np.random.Generator,
    restarts: int = RESTARTS,
) -> bool:
    """Return whether some arm motion holds the handle from the first to the last planned joint value.

    The gripper may tilt within LEAN_RAD about the handle, and change its tilt steadily as the part moves; the
    fingers may be exchanged.

    Args:
        scene: Scene with the object at its pose.
        start_joints: Arm joints of the demonstration (J,), at which the robot's
            colliders may touch one another.
        rng: Generator of arms and grasps.
        restarts: Number of restarts.

    Not checked: the motion to the handle and back, speed, forces, the fingers' grip.
    """
    checker = _Checker(scene, fitted, start_joints)
    if checker.stands_in_robot():
        return False
    return any(checker.attempt(rng) for _ in range(restarts))


@dataclass(frozen=True, slots=True)
class _Hold:
    """One grasp: tilt at the first and last value [rad], orientation of the fingers, depth of the bar [m]."""

    leans: tuple[float, float]
    side: float
    depth: float


class _Checker:
    """A scene, its state, and the path of the handle, shared by all restarts."""

    def __init__(self, scene: Scene, fitted: FittedAsset, start_joints: Array) -> None:
        asset = fitted.asset
        self._scene, self._data = scene, mujoco.MjData(scene.model)
        self._limits = scene.robot.joint_limits
        self._thetas = np.linspace(fitted.start_theta, fitted.target_theta, SAMPLES)
        static = scene.model.body(scene.names.static_body).id
        T_world_object = transform(np.zeros((3, 3)), scene.model.body_pos[static])
        R = np.zeros(9)
        mujoco.mju_quat2Mat(R, scene.model.body_quat[static])
        T_world_object[:3, :3] = R.reshape(3, 3)
        self._Ts_world_part = T_world_object @ asset.joint.motion(self._thetas)
        self._held = apply(self._Ts_world_part, fitted.contact_asset[None]).reshape(-1, 3)
        self._approach, self._bar = -outward_normal(asset), asset.handle_axis
        bar = asset.handle_bar
        width = 0.0 if bar is None else 2 * float(bar.half_extents.min())
        self._gripper = holding_gripper(scene.robot, width, 0.5)
        self._allowed = OVERLAP_M + self._overlap(start_joints, 0.0, own=True)

    def stands_in_robot(self) -> bool:
        """Return whether the object overlaps the robot's base; MuJoCo skips pairs of static bodies."""
        model, roles = self._scene.model, self._scene.roles
        welded = model.body_weldid[model.geom_bodyid] == 0
        solid = model.geom_contype | model.geom_conaffinity > 0
        feet, boxes = np.flatnonzero(roles.robot & welded & solid), np.flatnonzero(roles.static)
        return any(
            mujoco.mj_geomDistance(model, self._data, int(foot), int(box), 1.0, None) < -OVERLAP_M
            for foot in feet
            for box in boxes
        )

    def attempt(self, rng: np.random.Generator) -> bool:
        """Return whether a random grasp, reached from a random arm, holds to the end."""
        leans = rng.uniform(-LEAN_RAD, LEAN_RAD, 2)
        hold = _Hold((leans[0], leans[1]), rng.choice([-1.0, 1.0]), rng.uniform(*DEPTHS_M))
        low, high = np.clip(self._limits, -np.pi, np.pi).T
        joints = rng.uniform(low, high)
        for sample, theta in enumerate(self._thetas):
            target = self._hand(sample, hold)
            found = self._reach(target, joints, FIRST_STEPS if sample == 0 else NEXT_STEPS)
            if found is None or (sample and not np.abs(found - joints).max() <= BRANCH_RAD):
                return False
            joints = found
            if not self._clear(joints, theta):
                return False
        return True

    def _hand(self, sample: int, hold: _Hold) -> Array:
        """Compute the pose of the end effector (4, 4): z out of the palm, x along the bar."""
        share = sample / (SAMPLES - 1)
        lean = (1 - share) * hold.leans[0] + share * hold.leans[1]
        # The approach is square to the bar, whatever the front's normal is.
        across = self._approach - (self._approach @ self._bar) * self._bar
        z = matrix_from_rotvec(lean * self._bar) @ (across / np.linalg.norm(across))
        x = hold.side * self._bar
        R = self._Ts_world_part[sample, :3, :3] @ np.stack([x, np.cross(z, x), z], 1)
        return transform(R, self._held[sample] - hold.depth * R[:, 2])

    def _reach(self, target: Array, start: Array, steps: int) -> Array | None:
        """Solve arm joints (J,) at a pose by damped least squares; None without convergence within limits."""
        scene, data, joints = self._scene, self._data, start
        low, high = self._limits.T
        jacobian = np.zeros((6, scene.model.nv))
        for _ in range(steps):
            data.qpos[scene.arm.qpos] = joints
            mujoco.mj_kinematics(scene.model, data)
            mujoco.mj_comPos(scene.model, data)
            R = data.site_xmat[scene.ee_site].reshape(3, 3)
            shift = target[:3, 3] - data.site_xpos[scene.ee_site]
            turn = rotvec_from_matrix(target[:3, :3] @ R.T)
            if np.linalg.norm(shift) <= REACHED_M and np.linalg.norm(turn) <= REACHED_RAD:
                return joints
            mujoco.mj_jacSite(scene.model, data, jacobian[:3], jacobian[3:], scene.ee_site)
            J = jacobian[:, scene.arm.dofs]
            step = J.T @ np.linalg.solve(J @ J.T + DAMPING * np.eye(6), np.concatenate([shift, turn]))
            step *= min(1.0, LONGEST_STEP_RAD / max(float(np.abs(step).max()), 1e-9))
            joints = np.clip(joints + step, low, high)
        return None

    def _clear(self, joints: Array, theta: float) -> bool:
        return (
            self._overlap(joints, theta, own=False) <= OVERLAP_M
            and self._overlap(joints, theta, own=True) <= self._allowed
        )

    def _overlap(self, joints: Array, theta: float, *, own: bool) -> float:
        """Compute the deepest overlap of the robot with itself, or with anything but the held object, [m]."""
        scene, data, roles = self._scene, self._data, self._scene.roles
        data.qpos[:] = scene.qpos(joints[None], self._gripper, theta)[0]
        mujoco.mj_kinematics(scene.model, data)
        mujoco.mj_comPos(scene.model, data)
        mujoco.mj_collision(scene.model, data)
        pairs = data.contact.geom
        robot = roles.robot[pairs]
        held = roles.gripper[pairs].any(1) & roles.handle[pairs].any(1)
        wanted = robot.all(1) & ~roles.gripper[pairs].all(1) if own else (robot.sum(1) == 1) & ~held
        return float(-data.contact.dist[wanted].min(initial=0.0))
