"""A robot arm with its gripper: kinematics, visual meshes and finger pads.

World is the root frame of the model file; for the built-in UR5e that is ROS `base_link`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.transforms import matrix_from_quat, transform
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays
from aomgen.robots.geom_meshes import RobotMesh
from aomgen.robots.gripper import GripperTable


@dataclass(frozen=True, slots=True, kw_only=True)
class FingerPad:
    """The face with which one finger holds, as a box behind it.

    Attributes:
        finger: "left" or "right".
        body: Index into `RobotModel.body_names`.
        T_body_pad: Pose of the box (4, 4), z towards the other finger.
        half_extents: (3,), [m].
    """

    finger: str
    body: int
    T_body_pad: Matrix4
    half_extents: Vector3

    __post_init__ = freeze_arrays

    @property
    def normal_body(self) -> Array:
        """Unit direction (3,) from the pad towards the other finger, body frame."""
        return self.T_body_pad[:3, 2]

    @property
    def center_body(self) -> Array:
        """Middle of the box (3,), body frame, [m]."""
        return self.T_body_pad[:3, 3]

    @property
    def face_body(self) -> Array:
        """Middle of the face that looks at the other finger (3,), body frame, [m]."""
        return self.center_body + self.half_extents[2] * self.normal_body


@dataclass(frozen=True, slots=True, kw_only=True)
class HandDrive:
    """What a gripper value means to the hand.

    Attributes:
        driver: Finger joint that the value measures.
        driver_range: Its values at gripper 0 and 1 (2,), [rad] or [m].
        actuator: Closes the hand.
        control_range: Its control at gripper 0 and 1 (2,).
    """

    driver: str
    driver_range: tuple[float, float]
    actuator: str
    control_range: tuple[float, float]


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
    """

    name: str
    joint_names: Annotated[tuple[str, ...], "N"]
    body_names: tuple[str, ...]
    joint_limits: Annotated[Array, "N 2"]
    slides: Annotated[NDArray[np.bool_], "N"]
    gripper_table: GripperTable
    meshes: tuple[RobotMesh, ...]
    pads: tuple[FingerPad, ...]
    pad_geoms: Mapping[str, tuple[str, ...]]
    drive: HandDrive | None
    hand_bodies: tuple[str, ...]
    ee_site: str
    _model: mujoco.MjModel
    _full: mujoco.MjSpec
    _bare: mujoco.MjSpec

    __post_init__ = freeze_arrays

    @property
    def approach_ee(self) -> Array:
        """Unit direction (3,) out of the palm, end effector frame."""
        return np.array([0.0, 0.0, 1.0])

    @property
    def closing_ee(self) -> Array:
        """Unit direction (3,) from the left to the right finger, end effector frame."""
        return np.array([0.0, 1.0, 0.0])

    def spec(self, *, visual: bool = True) -> mujoco.MjSpec:
        """A fresh editable MuJoCo description: radians, dense Jacobian, elliptic cones, impratio 10.

        Args:
            visual: False leaves out what is only seen, which compiles ten times faster.
        """
        return (self._full if visual else self._bare).copy()

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
        return body_poses(self._model, self.qpos(joints, gripper))[:, 1:]

    def ee_poses(self, joints: ArrayLike) -> Array:
        """Poses T_world_ee (T, 4, 4) of the end effector site for joints (T, J)."""
        return site_poses(self._model, self.qpos(joints, 0.0), self.ee_site)


def body_poses(model: mujoco.MjModel, states: Array) -> Array:
    """Poses T_world_body (K, B, 4, 4) of all bodies, the world included, for states (K, nq)."""
    found = [(data.xpos.copy(), data.xquat.copy()) for data in _posed(model, states)]
    positions, quats = (np.array(part) for part in zip(*found, strict=True))
    return transform(matrix_from_quat(quats), positions)


def site_poses(model: mujoco.MjModel, states: Array, site: str) -> Array:
    """Poses T_world_site (K, 4, 4) for states (K, nq)."""
    found = [
        (data.site(site).xmat.reshape(3, 3).copy(), data.site(site).xpos.copy())
        for data in _posed(model, states)
    ]
    rotations, positions = (np.array(part) for part in zip(*found, strict=True))
    return transform(rotations, positions)


def _posed(model: mujoco.MjModel, states: Array) -> Iterator[mujoco.MjData]:
    data = mujoco.MjData(model)
    for row in states:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        yield data
