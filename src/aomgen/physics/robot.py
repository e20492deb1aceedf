"""A robot arm with its gripper: kinematics, visual meshes and finger pads.

World is the root frame of the model file; for the built-in UR5e that is ROS `base_link`.
"""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.assets.mjcf import VISUAL_GROUP
from aomgen.core.transforms import matrix_from_quat, transform
from aomgen.core.values import Array, freeze
from aomgen.errors import ConfigError, MalformedFileError, MissingFileError
from aomgen.physics.gripper import GripperTable, settled_fingers
from aomgen.physics.robot_files import KNOWN_ROBOTS, RobotFiles, build_spec


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotMesh:
    """One visual mesh of the robot.

    Attributes:
        body: Index into `RobotModel.body_names`.
        vertices_body: (V, 3), body frame, [m].
        faces: (F, 3) vertex indices.
        color_srgb: Material color (3,), 0..1.
    """

    body: int
    vertices_body: Array
    faces: NDArray[np.int64]
    color_srgb: Array

    def __post_init__(self) -> None:
        freeze(self, "vertices_body", self.vertices_body, (None, 3))
        freeze(self, "faces", self.faces, (None, 3), np.int64)
        freeze(self, "color_srgb", self.color_srgb, (3,))


@dataclass(frozen=True, slots=True, kw_only=True)
class FingerPad:
    """The rubber face of one finger, as a box along the axes of its body.

    Attributes:
        finger: "left" or "right".
        body: Index into `RobotModel.body_names`.
        center_body, half_extents: The box (3,), body frame, [m].
        normal_body: Unit direction (3,) from the pad towards the other finger.
    """

    finger: str
    body: int
    center_body: Array
    half_extents: Array
    normal_body: Array

    def __post_init__(self) -> None:
        for name in ("center_body", "half_extents", "normal_body"):
            freeze(self, name, getattr(self, name), (3,))


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotModel:
    """Arm and gripper as one kinematic model; J arm joints, B bodies.

    Attributes:
        name: For example "ur5e_2f85".
        files: Where the model comes from; `spec` builds it again from there.
        joint_names: The J arm joints, in the order of every `joints` argument.
        body_names: The B bodies in MuJoCo's order, world left out: body b is MuJoCo's b + 1.
        joint_limits: (J, 2), [rad].
        gripper_table: Finger joints over the gripper value 0 (open) .. 1 (closed).
        meshes: Visual meshes.
        pads: Finger pads; empty when the model names none.
        ee_site: Name of the site that is the end effector (between the pads).
    """

    name: str
    files: RobotFiles
    joint_names: tuple[str, ...]
    body_names: tuple[str, ...]
    joint_limits: Array
    gripper_table: GripperTable
    meshes: tuple[RobotMesh, ...]
    pads: tuple[FingerPad, ...]
    ee_site: str
    _model: mujoco.MjModel

    def __post_init__(self) -> None:
        freeze(self, "joint_limits", self.joint_limits, (len(self.joint_names), 2))

    def spec(self, *, visual: bool = True) -> mujoco.MjSpec:
        """A fresh editable MuJoCo description: radians, dense Jacobian, elliptic cones, impratio 10.

        Args:
            visual: False leaves out what is only seen, which compiles ten times faster.
        """
        return build_spec(self.files, visual=visual)

    def qpos(self, joints: ArrayLike, gripper: ArrayLike) -> Array:
        """Generalised positions (T, nq) of the robot alone, fingers settled for each gripper value.

        Args:
            joints: (T, J), [rad].
            gripper: (T,), 0 open .. 1 closed; values outside are clipped.
        """
        joints = np.atleast_2d(np.asarray(joints, np.float64))
        qpos = np.repeat(self._model.qpos0[None], len(joints), 0)
        addresses = [self._model.joint(name).qposadr[0] for name in self.joint_names]
        qpos[:, addresses] = joints
        if self.gripper_table.joint_names:
            fingers = [self._model.joint(name).qposadr[0] for name in self.gripper_table.joint_names]
            qpos[:, fingers] = self.gripper_table.at(np.broadcast_to(gripper, len(joints)))
        return qpos

    def link_poses(self, joints: ArrayLike, gripper: ArrayLike) -> Array:
        """Poses T_world_body (T, B, 4, 4) of all bodies; arguments as `qpos`."""
        bodies, _ = self._kinematics(self.qpos(joints, gripper))
        return bodies

    def ee_poses(self, joints: ArrayLike) -> Array:
        """Poses T_world_ee (T, 4, 4) of the end effector site for joints (T, J)."""
        _, ee = self._kinematics(self.qpos(joints, 0.0))
        return ee

    def _kinematics(self, qpos: Array) -> tuple[Array, Array]:
        data = mujoco.MjData(self._model)
        site = self._model.site(self.ee_site).id
        positions = np.empty((len(qpos), self._model.nbody, 3))
        quats = np.empty((len(qpos), self._model.nbody, 4))
        ee = np.empty((len(qpos), 4, 4))
        for t, row in enumerate(qpos):
            data.qpos[:] = row
            mujoco.mj_kinematics(self._model, data)
            positions[t], quats[t] = data.xpos, data.xquat
            ee[t] = transform(data.site_xmat[site].reshape(3, 3), data.site_xpos[site])
        return transform(matrix_from_quat(quats[:, 1:]), positions[:, 1:]), ee


def load_robot(model: str | Path, base_frame: str = "base_link") -> RobotModel:
    """Load a robot known by name, or a URDF or MJCF file.

    Args:
        model: "ur5e_2f85", or the path of a file. A file's arm joints are all its hinge and slide
            joints; its end effector is the site "pinch", "ee" or "attachment_site", else the
            last body. It has no gripper table and no pads.
        base_frame: World frame of the returned model: "base_link", or "ur_base", which is turned
            by 180 degrees about z.

    Raises:
        ConfigError: Unknown name or base frame, or the asset package is missing.
        MissingFileError, MalformedFileError: The file is missing or MuJoCo cannot read it.
    """
    if base_frame not in ("base_link", "ur_base"):
        raise ConfigError("robot.base_frame", f"'{base_frame}' is unknown", "use base_link or ur_base")
    files = _find(model, base_frame == "ur_base")
    try:
        compiled = build_spec(files).compile()
    except (ValueError, RuntimeError) as error:
        raise MalformedFileError(files.arm, f"cannot be read by MuJoCo ({error})", "correct it") from error
    table = settled_fingers(files)
    names = [compiled.joint(j).name for j in range(compiled.njnt)]
    gripper_prefix = files.prefix if files.gripper else None
    arm = [name for name in names if gripper_prefix is None or not name.startswith(gripper_prefix)]
    limits = [
        compiled.joint(name).range if compiled.joint(name).limited else (-np.inf, np.inf) for name in arm
    ]
    return RobotModel(
        name=files.name,
        files=files,
        joint_names=tuple(arm),
        body_names=tuple(compiled.body(b).name for b in range(1, compiled.nbody)),
        joint_limits=np.array(limits).reshape(-1, 2),
        gripper_table=table,
        meshes=_visual_meshes(compiled),
        pads=_finger_pads(compiled, files),
        ee_site=files.ee_site,
        _model=compiled,
    )


def _find(model: str | Path, turned: bool) -> RobotFiles:
    if isinstance(model, str) and model in KNOWN_ROBOTS:
        return KNOWN_ROBOTS[model](turned)
    path = Path(model)
    if not path.suffix:
        raise ConfigError("robot.model", f"'{model}' is unknown", f"known: {', '.join(sorted(KNOWN_ROBOTS))}")
    if not path.is_file():
        raise MissingFileError(path, "is missing", "check robot.urdf or robot.mjcf")
    return RobotFiles(name=path.stem, arm=path, gripper=None, prefix="", turned=turned, ee_site="ee")


def _visual_meshes(model: mujoco.MjModel) -> tuple[RobotMesh, ...]:
    shown = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    if np.any(shown & (model.geom_group == VISUAL_GROUP)):
        shown &= model.geom_group == VISUAL_GROUP
    meshes = []
    for geom in np.flatnonzero(shown):
        mesh = model.geom_dataid[geom]
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        first, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        vertices, index = np.unique(model.mesh_vert[start : start + count], axis=0, return_inverse=True)
        R = matrix_from_quat(model.geom_quat[geom])
        material = model.geom_matid[geom]
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
        meshes.append(
            RobotMesh(
                body=int(model.geom_bodyid[geom]) - 1,
                vertices_body=vertices @ R.T + model.geom_pos[geom],
                faces=index.reshape(-1)[model.mesh_face[first : first + faces]],
                color_srgb=rgba[:3],
            )
        )
    return tuple(mesh for mesh in meshes if mesh.body >= 0)


def _finger_pads(model: mujoco.MjModel, files: RobotFiles) -> tuple[FingerPad, ...]:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    boxes = {}
    for finger, geoms in files.pad_geoms.items():
        ids = [model.geom(name).id for name in geoms]
        lower = np.min([model.geom_pos[i] - model.geom_size[i] for i in ids], 0)
        upper = np.max([model.geom_pos[i] + model.geom_size[i] for i in ids], 0)
        body = int(model.geom_bodyid[ids[0]])
        R = data.xmat[body].reshape(3, 3)
        boxes[finger] = (body, lower, upper, R, data.xpos[body] + R @ (lower + upper) / 2)
    pads = []
    for finger, (body, lower, upper, R, center_world) in boxes.items():
        others = [box[4] for name, box in boxes.items() if name != finger]
        towards = R.T @ (np.mean(others, 0) - center_world)
        axis = int(np.argmax(np.abs(towards)))
        pads.append(
            FingerPad(
                finger=finger,
                body=body - 1,
                center_body=(lower + upper) / 2,
                half_extents=(upper - lower) / 2,
                normal_body=np.sign(towards[axis]) * np.eye(3)[axis],
            )
        )
    return tuple(pads)
