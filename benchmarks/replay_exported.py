"""`aomgen bench replay-exported`: do exported actions open the exported object in somebody else's scene?"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
import pyarrow.parquet as pq

from aomgen.core.transforms import matrix_from_quat, rotvec_from_matrix, transform
from aomgen.core.values import Array
from aomgen.datasets.features import ee_targets
from aomgen.errors import MissingFileError
from aomgen.io.artifact import read_json
from aomgen.robots.loading import load_stored_robot
from aomgen.robots.robot import RobotModel
from benchmarks.foreign_scene import ForeignScene, foreign_scene

STATE, EE_POSE = "observation.state", "annotation.ee_pose"
FORCE, THETA = "annotation.finger_force", "annotation.object_joint"
COLUMNS: Final[dict[str, str]] = {
    "joint": "action",
    "ee_absolute": "annotation.action.ee_absolute",
    "ee_delta": "annotation.action.ee_delta",
}
# Newton steps a pose; the next one is a few centimetres away.
IK_STEPS: Final = 6
TWIN_FOLDER, EPISODES_FOLDER = "06_twin", "08_episodes"
# An object that stands this much farther along the gripper's approach cannot be opened by the same actions, [m].
AWAY_M: Final = 0.08
# Share of the planned opening that counts as opened, as in `physics.verify.PassRule`.
OPENED_SHARE: Final = 0.9
# How long the arm stands still before the first and after the last action, [s]; a lid would fall meanwhile.
BEFORE_S, AFTER_S = 0.2, 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """What a user gets of one episode.

    Attributes:
        usd: The object's file.
        T_world_object: Its pose (4, 4).
        states: (T, J + 1), arm joints [rad] and gripper 0..1.
        actions: By space: "joint" (T, J + 1), "ee_absolute" (T, 8), "ee_delta" (T, 7).
        ee_poses: Observed end effector (T, 7), position [m] and quaternion wxyz.
        forces: Of the fingers on the part (T,), [N].
        thetas: Stored joint value of the object (T,), [rad] or [m].
        target: Planned final joint value.
        fps: Frames a second.
    """

    usd: Path
    T_world_object: Array
    states: Array
    actions: dict[str, Array]
    ee_poses: Array
    forces: Array
    thetas: Array
    target: float
    fps: int


def run_replay(outs: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """Replay all exported episodes of some runs, as they are and with the object moved away.

    Args:
        outs: Folders of finished runs.

    Returns:
        By category: `episodes`, `opened` (at least 90 % of the plan), `theta_rmse`, `theta_worst` and
        `final_error` (replayed joint actions against stored joint values, in `unit`; the last after
        another second), `opened_when_moved`; `opened_by_ee_absolute`, `opened_by_ee_delta`, and
        `ee_delta_summed_error_mm` (see `summed_error_m`).

    Raises:
        MissingFileError: A run has no dataset.
    """
    rows: dict[str, list[dict[str, Any]]] = {}
    for out in outs:
        robot = load_stored_robot(out / TWIN_FOLDER)
        for episode in exported_episodes(out):
            category, row = _replayed(robot, episode)
            rows.setdefault(category, []).append(row)
    return {category: _summary(items) for category, items in sorted(rows.items())}


def exported_episodes(out: Path) -> Iterator[Exported]:
    """The episodes of a run's dataset, one after the other.

    Raises:
        MissingFileError: The run has no dataset.
    """
    meta = out / "dataset" / "meta"
    if not (meta / "info.json").is_file():
        raise MissingFileError(meta, "is missing", "finish the run first")
    fps = int(read_json(meta / "info.json")["fps"])
    table = pq.read_table(out / "dataset" / "data")
    columns = {
        name: np.array(table[name].to_pylist(), np.float64)
        for name in (*COLUMNS.values(), STATE, EE_POSE, FORCE, THETA)
    }
    owner = np.array(table["episode_index"])
    for row in pq.read_table(meta / "episodes").to_pylist():
        folder = out / EPISODES_FOLDER / f"{row['aomgen/source_index']:06d}"
        described = read_json(folder / "episode.json")
        mine = owner == row["episode_index"]
        yield Exported(
            usd=folder / described["asset_usd"],
            T_world_object=np.array(described["T_world_object"]),
            states=columns[STATE][mine],
            actions={space: columns[name][mine] for space, name in COLUMNS.items()},
            ee_poses=columns[EE_POSE][mine],
            forces=columns[FORCE][mine].sum(1),
            thetas=columns[THETA][mine],
            target=described["verdict"]["target_theta"],
            fps=fps,
        )


def summed_error_m(episode: Exported) -> float:
    """How far from the planned path all deltas end when they are added up from the first pose, [m].

    Each delta counts from an observed pose, so every frame's tracking error is added as well.
    """
    T = _poses(episode.ee_poses[:1])
    for delta in episode.actions["ee_delta"]:
        T = ee_targets(T, delta[None, :6])
    return float(np.linalg.norm(T[0, :3, 3] - episode.actions["ee_absolute"][-1, :3]))


class Replay:
    """One episode in one foreign scene; a builder that holds what all its steps share."""

    def __init__(self, scene: ForeignScene, robot: RobotModel, episode: Exported, space: str) -> None:
        self._scene, self._robot, self._episode, self._space = scene, robot, episode, space
        self._data, self._scratch = mujoco.MjData(scene.model), mujoco.MjData(scene.model)
        self._steps = math.ceil(1 / (episode.fps * scene.model.opt.timestep))
        scene.model.opt.timestep = 1 / (episode.fps * self._steps)
        biases = scene.model.actuator_biasprm[scene.actuators]
        self._lead = biases[:, 2] / biases[:, 1]

    def run(self) -> Array:
        """Replay without looking ahead.

        At frame t nothing but `actions[: t + 1]` is known: the command moves straight from the last
        target to the new one, which it reaches at frame t + 1.

        Returns:
            Joint value of the object at every frame and after the last action (T + 1,), [rad] or [m].
        """
        episode, data = self._episode, self._data
        last = episode.states[0]
        start = self._robot.qpos(last[:-1], last[-1])[0]
        data.qpos[: len(start)] = start
        self._stand(last, BEFORE_S)
        thetas = []
        for frame, action in enumerate(episode.actions[self._space]):
            thetas.append(float(data.qpos[self._scene.theta]))
            target = self._joint_target(frame, action, last)
            for step in range(self._steps):
                share = step / self._steps
                self._command(last + share * (target - last), (target - last) * episode.fps)
                mujoco.mj_step(self._scene.model, data)
            last = target
        self._stand(last, AFTER_S)
        return np.array([*thetas, float(data.qpos[self._scene.theta])])

    def _joint_target(self, frame: int, action: Array, last: Array) -> Array:
        """Arm joints and gripper (J + 1,) that an action asks for; a delta counts from the recorded pose."""
        if self._space == "joint":
            return action
        if self._space == "ee_absolute":
            T = _poses(action[None])
        else:
            T = ee_targets(_poses(self._episode.ee_poses[frame][None]), action[None, :6])
        return np.append(self._solved(T[0], last[:-1]), action[-1])

    def _solved(self, T_world_target: Array, near: Array) -> Array:
        """Arm joints (J,) that reach a pose, by Newton steps from joints nearby."""
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


def _replayed(robot: RobotModel, episode: Exported) -> tuple[str, dict[str, Any]]:
    scene = foreign_scene(robot, episode.usd, episode.T_world_object)
    scale = np.rad2deg(1.0) if scene.revolute else 1000.0
    enough = OPENED_SHARE * episode.target
    row: dict[str, Any] = {
        "unit": "deg" if scene.revolute else "mm",
        "summed_mm": 1000 * summed_error_m(episode),
    }
    for space in COLUMNS:
        thetas = Replay(scene, robot, episode, space).run()
        row[space] = {
            "opened": bool(thetas[-1] >= enough),
            "errors": scale * (thetas[:-1] - episode.thetas),
            "final_error": scale * abs(float(thetas[-1] - episode.thetas[-1])),
        }
    away = episode.T_world_object.copy()
    touching = _poses(episode.ee_poses[[np.argmax(episode.forces > 0)]])[0]
    away[:3, 3] += AWAY_M * touching[:3, :3] @ robot.approach_ee
    missed = Replay(foreign_scene(robot, episode.usd, away), robot, episode, "joint").run()
    return scene.category, row | {"opened_when_moved": bool(missed[-1] >= enough)}


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    by_joint = [row["joint"] for row in rows]
    errors = np.concatenate([row["errors"] for row in by_joint])
    return {
        "episodes": len(rows),
        "opened": sum(row["opened"] for row in by_joint),
        "opened_by_ee_absolute": sum(row["ee_absolute"]["opened"] for row in rows),
        "opened_by_ee_delta": sum(row["ee_delta"]["opened"] for row in rows),
        "opened_when_moved": sum(row["opened_when_moved"] for row in rows),
        "theta_rmse": float(np.sqrt(np.mean(errors**2))),
        "theta_worst": float(np.abs(errors).max()),
        "final_error": max(row["final_error"] for row in by_joint),
        "unit": rows[0]["unit"],
        "ee_delta_summed_error_mm": max(row["summed_mm"] for row in rows),
    }


def _poses(vectors: Array) -> Array:
    """Transforms (T, 4, 4) of positions and quaternions wxyz in the first seven columns of (T, D)."""
    return transform(matrix_from_quat(vectors[:, 3:7]), vectors[:, :3])
