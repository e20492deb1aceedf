"""A robot arm with its gripper: kinematics, visual meshes and finger pads.

World is the root frame of the model file; for the built-in UR5e that is ROS `base_link`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.robot_choice import HandChoice, RobotChoice
from aomgen.core.transforms import matrix_from_quat, transform
from aomgen.core.values import Array, freeze
from aomgen.errors import ConfigError, MalformedFileError
from aomgen.robots.from_file import FileRobot, read_file_robot
from aomgen.robots.gripper import GripperTable, no_fingers, simulate_finger_table
from aomgen.robots.robot_files import KNOWN_ROBOTS, RobotFiles, build_spec
from aomgen.robots.robot_parts import FingerPad, HandDrive, RobotMesh, pads_of_boxes, visual_meshes


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotModel:
    """Arm and gripper as one kinematic model; J arm joints, B bodies.

    Attributes:
        name: For example "ur5e_2f85".
        joint_names: The J arm joints, in the order of every `joints` argument.
        body_names: The B bodies in MuJoCo's order, world left out: body b is MuJoCo's b + 1.
        joint_limits: (J, 2), [rad] or [m].
        slides: Which arm joints (J,) are prismatic.
        gripper_table: Finger joints over the gripper value 0 (open) .. 1 (closed).
        meshes: Visual meshes.
        pads: Finger pads, left and right; empty for an arm without fingers.
        pad_geoms: Names of each finger's colliding shapes, by side.
        drive: What closes the hand; None for an arm without fingers.
        hand_bodies: Names of the bodies that hang on the last arm body.
        ee_site: Name of the site that is the end effector (between the pads).
        approach_ee, closing_ee: Unit directions (3,), end effector frame: out of the palm, and from
            the left to the right finger.
    """

    name: str
    joint_names: tuple[str, ...]
    body_names: tuple[str, ...]
    joint_limits: Array
    slides: NDArray[np.bool_]
    gripper_table: GripperTable
    meshes: tuple[RobotMesh, ...]
    pads: tuple[FingerPad, ...]
    pad_geoms: Mapping[str, tuple[str, ...]]
    drive: HandDrive | None
    hand_bodies: tuple[str, ...]
    ee_site: str
    approach_ee: Array
    closing_ee: Array
    _model: mujoco.MjModel
    _build: Callable[[bool], mujoco.MjSpec]

    def __post_init__(self) -> None:
        freeze(self, "joint_limits", self.joint_limits, (len(self.joint_names), 2))
        freeze(self, "slides", self.slides, (len(self.joint_names),), np.bool_)
        for name in ("approach_ee", "closing_ee"):
            freeze(self, name, getattr(self, name), (3,))

    def spec(self, *, visual: bool = True) -> mujoco.MjSpec:
        """A fresh editable MuJoCo description: radians, dense Jacobian, elliptic cones, impratio 10.

        Args:
            visual: False leaves out what is only seen, which compiles ten times faster.
        """
        return self._build(visual)

    def qpos(self, joints: ArrayLike, gripper: ArrayLike) -> Array:
        """Generalised positions (T, nq) of the robot alone, fingers settled for each gripper value.

        Args:
            joints: (T, J), [rad] or [m].
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


def load_robot(
    model: str | Path,
    base_frame: str = "base_link",
    *,
    joints: Sequence[str] = (),
    hand: HandChoice | None = None,
    root: Path | None = None,
) -> RobotModel:
    """Load a robot known by name, or a URDF or MJCF file.

    Args:
        model: "ur5e_2f85", or the path of a file.
        base_frame: World frame of the returned model: "base_link", or "ur_base", which is turned
            by 180 degrees about z.
        joints: Arm joints in the order wanted; empty takes the model's own. See `arm_chain`.
        hand: What the capture states about the gripper of a file; the rest is found, see `find_hand`.
        root: Folder that all references of a file stay in; None takes the file's own.

    Raises:
        ConfigError: Unknown name, base frame or joint, or the asset package is missing.
        InputError: The file cannot be used; of the kind that fits.
    """
    if base_frame not in ("base_link", "ur_base"):
        raise ConfigError("robot.base_frame", f"'{base_frame}' is unknown", "use base_link or ur_base")
    turned = base_frame == "ur_base"
    if isinstance(model, str) and model in KNOWN_ROBOTS:
        return _known(KNOWN_ROBOTS[model](turned), joints)
    path = Path(model)
    if not path.suffix:
        raise ConfigError("robot.model", f"'{model}' is unknown", f"known: {', '.join(sorted(KNOWN_ROBOTS))}")
    return _of_file(read_file_robot(path, root or path.parent, joints, hand or HandChoice(), turned=turned))


def choose_robot(choice: RobotChoice) -> RobotModel:
    """The robot of a capture, in the capture's world frame and joint order.

    Raises:
        As `load_robot`.
    """
    return load_robot(
        choice.model_file or choice.model,
        choice.base_frame,
        joints=choice.joints,
        hand=choice.hand,
        root=choice.root,
    )


def _known(files: RobotFiles, joints: Sequence[str]) -> RobotModel:
    try:
        compiled = build_spec(files).compile()
    except (ValueError, RuntimeError) as error:
        raise MalformedFileError(files.arm, f"cannot be read by MuJoCo ({error})", "correct it") from error
    names = [compiled.joint(j).name for j in range(compiled.njnt)]
    arm = tuple(name for name in names if not name.startswith(files.prefix))
    if joints and sorted(joints) != sorted(arm):
        raise ConfigError(
            "robot.joints", f"do not name the joints of {files.name}", f"list these: {', '.join(arm)}"
        )
    driver, closed = files.driver
    actuator, control = files.actuator
    bodies = tuple(compiled.body(b).name for b in range(1, compiled.nbody))
    return _assembled(
        compiled,
        tuple(joints) or arm,
        name=files.name,
        gripper_table=simulate_finger_table(files),
        pads=pads_of_boxes(compiled, files.pad_geoms),
        pad_geoms=files.pad_geoms,
        drive=HandDrive(
            driver=driver, driver_range=(0.0, closed), actuator=actuator, control_range=(0.0, control)
        ),
        hand_bodies=tuple(name for name in bodies if name.startswith(files.prefix)),
        ee_site=files.ee_site,
        approach_ee=np.array([0.0, 0.0, 1.0]),
        closing_ee=np.array([0.0, 1.0, 0.0]),
        _build=partial(_fresh, files),
    )


def _fresh(files: RobotFiles, visual: bool) -> mujoco.MjSpec:
    return build_spec(files, visual=visual)


def _of_file(item: FileRobot) -> RobotModel:
    compiled, hand = item.full.copy().compile(), item.hand
    approach, closing = _hand_axes(compiled, item)
    drive, pads, table = None, (), no_fingers()
    if hand is not None:
        (driver, ends), *_ = hand.driven.items()
        drive = HandDrive(driver=driver, driver_range=ends, actuator=item.actuator, control_range=ends)
        table = hand.table
        pads = tuple(
            FingerPad(
                finger=side, body=face.body - 1, T_body_pad=face.T_body_pad, half_extents=face.half_extents
            )
            for side, face in zip(item.pad_geoms, hand.faces, strict=True)
        )
    return _assembled(
        compiled,
        item.chain.joints,
        name=item.name,
        gripper_table=table,
        pads=pads,
        pad_geoms=item.pad_geoms,
        drive=drive,
        hand_bodies=item.hand_bodies,
        ee_site=item.ee_site,
        approach_ee=approach,
        closing_ee=closing,
        _build=partial(_copied, item.full, item.bare),
    )


def _copied(full: mujoco.MjSpec, bare: mujoco.MjSpec, visual: bool) -> mujoco.MjSpec:
    return (full if visual else bare).copy()


def _hand_axes(model: mujoco.MjModel, item: FileRobot) -> tuple[Array, Array]:
    """Approach and closing direction (3,) in the frame of the end effector site."""
    if item.hand is None:
        return np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    R_body_site = matrix_from_quat(model.site_quat[model.site(item.ee_site).id])
    body = int(model.site_bodyid[model.site(item.ee_site).id])
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    R_body_hand = data.xmat[body].reshape(3, 3).T @ data.xmat[item.chain.last_body].reshape(3, 3)
    R_site_grasp = R_body_site.T @ R_body_hand @ item.hand.T_hand_ee[:3, :3]
    return R_site_grasp[:, 2], R_site_grasp[:, 1]


def _assembled(model: mujoco.MjModel, joints: tuple[str, ...], **parts: object) -> RobotModel:
    """What follows from the compiled model and is the same for every robot."""
    items = [model.joint(name) for name in joints]
    limits = [item.range if item.limited[0] else (-np.inf, np.inf) for item in items]
    return RobotModel(
        joint_names=joints,
        body_names=tuple(model.body(b).name for b in range(1, model.nbody)),
        joint_limits=np.array(limits).reshape(-1, 2),
        slides=np.array([int(item.type[0]) == mujoco.mjtJoint.mjJNT_SLIDE for item in items]),
        meshes=visual_meshes(model),
        _model=model,
        **parts,  # pyright: ignore[reportArgumentType]
    )
