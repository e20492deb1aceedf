"""Inverse kinematics for planning synthetic demonstrations: damped least squares on MuJoCo."""

from dataclasses import dataclass

import mujoco
import numpy as np

from aomgen.core.transforms import rotvec_from_matrix
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel

# Damping of the least squares: small against squared lever arms of 0.1 to 1 m, large against rounding.
DAMPING = 1e-4
# Largest change of a joint in one step, [rad]: the linear model holds that far.
MAX_STEP_RAD = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class IkSolution:
    """Joints (J,), [rad] or [m], and what is left to the target: [m] and [rad]."""

    joints: Array
    position_error: float
    rotation_error: float

    @property
    def exact(self) -> bool:
        """Whether the target is met within 0.5 mm and 0.2 degrees."""
        return self.position_error < 5e-4 and self.rotation_error < np.deg2rad(0.2)


class ArmKinematics:
    """Scratch kinematics of the arm inside a compiled model; not thread safe."""

    def __init__(self, model: mujoco.MjModel, robot: RobotModel) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        self._site = model.site(robot.ee_site).id
        self._qpos = np.array([model.joint(name).qposadr[0] for name in robot.joint_names])
        self._dofs = np.array([model.joint(name).dofadr[0] for name in robot.joint_names])
        self._limits = robot.joint_limits

    def solve(self, T_world_ee: Array, start: Array, *, iterations: int = 60) -> IkSolution:
        """Joints that bring the end effector site to a pose (4, 4), near `start` (J,)."""
        joints = np.array(start, np.float64)
        position, turn = self._errors(T_world_ee, joints)
        for _ in range(iterations):
            if np.linalg.norm(position) < 1e-5 and np.linalg.norm(turn) < 1e-5:
                break
            J = np.zeros((6, self._model.nv))
            mujoco.mj_jacSite(self._model, self._data, J[:3], J[3:], self._site)
            J = J[:, self._dofs]
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
        self._data.qpos[self._qpos] = joints
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        R = self._data.site_xmat[self._site].reshape(3, 3)
        position = T_world_ee[:3, 3] - self._data.site_xpos[self._site]
        return position, rotvec_from_matrix(T_world_ee[:3, :3] @ R.T)
