"""Exported values of an episode, and its replay in a scene made of these values alone."""

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.core.episode import Episode
from aomgen.core.transforms import matrix_from_quat, rotvec_from_matrix, transform
from aomgen.core.values import Array
from aomgen.datasets.features import ACTION_SPACES, ee_targets, feature_columns
from aomgen.robots.robot import RobotModel
from benchmarks.foreign_scene import ForeignScene

# Columns of a dataset.
STATE, EE_POSE = "observation.state", "annotation.ee_pose"
FORCE, THETA = "annotation.finger_force", "annotation.object_joint"
# Newton steps per pose; the next one is a few centimetres away.
IK_STEPS: Final = 6
# An object moved by this along the gripper's approach cannot be opened or closed by the same actions, [m].
AWAY_M: Final = 0.08
# Time that the arm rests before the first and after the last action, [s]; a lid would fall meanwhile.
BEFORE_S, AFTER_S = 0.2, 1.0
# Limits of a successful replay, as in `simulation.judge.PassRule`: share of the planned travel made,
# share of the progress made while pads carry force, least force of a contact [N], and share of the
# travel made before it.
OPENED_SHARE, CONTACT_SHARE, CARRIED_N, EARLY_SHARE = 0.9, 0.8, 0.5, 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """Exported values of one episode.

    Attributes:
        usd: USD file of the object.
        T_world_object: Its pose (4, 4).
        states: (T, J + 1), arm joints [rad] and gripper 0..1.
        actions: By space: "joint" (T, J + 1), "ee_absolute" (T, 8), "ee_delta" (T, 7).
        ee_poses: Observed end effector (T, 7), position [m] and quaternion wxyz.
        forces: Forces of the fingers on the part (T,), [N].
        thetas: Stored joint value of the object (T,), [rad] or [m].
        planned: First and final joint value of the plan.
        fps: Frames per second.
    """

    usd: Path
    T_world_object: Array
    states: Array
    actions: dict[str, Array]
    ee_poses: Array
    forces: Array
    thetas: Array
    planned: tuple[float, float]
    fps: int

    def shares(self, thetas: Array) -> Array:
        """Compute the share of the planned travel at joint values (N,)."""
        first, last = self.planned
        return (thetas - first) / (last - first)

    def moved_away(self, robot: RobotModel) -> "Exported":
        """Move the object by AWAY_M along the gripper's approach at first contact, with the same actions."""
        touching = poses_of(self.ee_poses[[np.argmax(self.forces > 0)]])[0]
        T = self.T_world_object.copy()
        T[:3, 3] += AWAY_M * touching[:3, :3] @ robot.approach_ee
        return replace(self, T_world_object=T)


def exported_of(episode: Episode, usd: Path) -> Exported:
    """Convert an episode to the values of its dataset, in single precision."""
    columns = {
        name: values.astype(np.float32).astype(np.float64)
        for name, values in feature_columns(episode).items()
    }
    return exported_from(columns, usd, episode.T_world_object, episode.verdict, round(episode.fps))


def exported_from(
    columns: dict[str, Array], usd: Path, T_world_object: Array, verdict: Mapping[str, Any], fps: int
) -> Exported:
    """Build an episode from its columns in the dataset (T, D) by name, and its certificate."""
    return Exported(
        usd=usd,
        T_world_object=T_world_object,
        states=columns[STATE],
        actions={
            space: columns.get(f"annotation.action.{space}", columns["action"]) for space in ACTION_SPACES
        },
        ee_poses=columns[EE_POSE],
        forces=columns[FORCE].sum(1),
        thetas=columns[THETA].ravel(),
        planned=(verdict["start_theta"], verdict["target_theta"]),
        fps=fps,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Opening:
    """Result of a replay: the object's joint (T + 1,) at every frame and after the last action, [rad] or [m], and
    where a pad carried force (T + 1,)."""

    thetas: Array
    carried: NDArray[np.bool_]


class Replay:
    """One episode in one foreign scene, with the state that all steps share."""

    def __init__(
        self,
        scene: ForeignScene,
        robot: RobotModel,
        episode: Exported,
        space: str = "joint",
        setting: int = 0,
    ) -> None:
        """Choose an action space, and one of the resistances in the object's file."""
        model = copy.copy(scene.model)
        self._steps = math.ceil(1 / (episode.fps * model.opt.timestep))
        model.opt.timestep = 1 / (episode.fps * self._steps)
        model.dof_damping[scene.theta_dof], model.dof_frictionloss[scene.theta_dof] = scene.resistances[
            setting
        ]
        self._scene, self._robot = replace(scene, model=model), robot
        self._episode, self._space = episode, space
        self._data, self._scratch = mujoco.MjData(model), mujoco.MjData(model)
        biases = model.actuator_biasprm[scene.actuators]
        self._lead = biases[:, 2] / biases[:, 1]

    def run(self) -> Opening:
        """Replay without access to future actions.

        At frame t only `actions[: t + 1]` is known: the command moves straight from the last
        target to the new one, which it reaches at frame t + 1.
        """
        episode, data = self._episode, self._data
        last = episode.states[0]
        start = self._robot.qpos(last[:-1], last[-1])[0]
        data.qpos[: len(start)] = start
        data.qpos[self._scene.theta] = episode.planned[0]
        self._stand(last, BEFORE_S)
        thetas, carried = [], []
        for action in episode.actions[self._space]:
            thetas.append(float(data.qpos[self._scene.theta]))
            carried.append(self._carries())
            target = self._joint_target(action, last)
            for step in range(self._steps):
                share = step / self._steps
                self._command(last + share * (target - last), (target - last) * episode.fps)
                mujoco.mj_step(self._scene.model, data)
            last = target
        self._stand(last, AFTER_S)
        thetas.append(float(data.qpos[self._scene.theta]))
        carried.append(self._carries())
        return Opening(thetas=np.array(thetas), carried=np.array(carried))

    def _carries(self) -> bool:
        """Return whether the pads press on the moving link."""
        model, data, wrench, total = self._scene.model, self._data, np.zeros(6), 0.0
        for index in range(data.ncon):
            pair = data.contact[index].geom
            on_part = model.geom_bodyid[pair] == self._scene.moving
            if on_part.any() and np.isin(pair, self._scene.pads).any():
                mujoco.mj_contactForce(model, data, index, wrench)
                total += wrench[0]
        return total >= CARRIED_N

    def _joint_target(self, action: Array, last: Array) -> Array:
        """Compute arm joints and gripper (J + 1,) of an action; a delta is relative to the last target."""
        if self._space == "joint":
            return action
        if self._space == "ee_absolute":
            T = poses_of(action[None])
        else:
            T = ee_targets(self._robot.ee_poses(last[None, :-1]), action[None, :6])
        return np.append(self._solved(T[0], last[:-1]), action[-1])

    def _solved(self, T_world_target: Array, near: Array) -> Array:
        """Solve arm joints (J,) that reach a pose, by Newton steps from joints nearby."""
        model, data = self._scene.model, self._scratch
        data.qpos[:] = self._data.qpos
        data.qpos[self._scene.arm] = near
        for _ in range(IK_STEPS):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            T = self._ee_pose(data)
            turn = rotvec_from_matrix(T_world_target[:3, :3] @ T[:3, :3].T)
            error = np.concatenate([T_world_target[:3, 3] - T[:3, 3], turn])
            jacobian = np.zeros((6, model.nv))
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], self._scene.ee_site)
            data.qpos[self._scene.arm] += np.linalg.lstsq(jacobian[:, self._scene.dofs], error, rcond=1e-6)[0]
        return data.qpos[self._scene.arm].copy()

    def _ee_pose(self, data: mujoco.MjData) -> Array:
        site = self._scene.ee_site
        return transform(data.site_xmat[site].reshape(3, 3), data.site_xpos[site])

    def _stand(self, target: Array, seconds: float) -> None:
        self._command(target, np.zeros_like(target))
        model = self._scene.model
        mujoco.mj_step(model, self._data, round(seconds / model.opt.timestep))

    def _command(self, target: Array, speed: Array) -> None:
        scene = self._scene
        opened, closed = scene.control_range
        self._data.ctrl[scene.actuators] = target[:-1] + self._lead * speed[:-1]
        self._data.ctrl[scene.gripper] = opened + target[-1] * (closed - opened)


def poses_of(vectors: Array) -> Array:
    """Build transforms (T, 4, 4) from positions and quaternions wxyz in the first seven columns of (T, D)."""
    return transform(matrix_from_quat(vectors[:, 3:7]), vectors[:, :3])
