"""A robot arm with its gripper: kinematics, visual meshes and finger pads.

The world frame is the root frame of the model file; for the built-in UR5e this is ROS `base_link`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.camera import Camera, CameraPath
from aomgen.core.mesh import sample_triangles
from aomgen.core.transforms import apply, matrix_from_quat, transform
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays
from aomgen.io.geom_surface import find_visible_geoms, geom_surface
from aomgen.robots.gripper import GripperTable

# Step of the numerical derivative with respect to a joint, [rad]; its error is far below a pixel.
_TURN_RAD = 1e-4
# Number of random configurations from which the workspace of an arm is estimated.
_REACH_SAMPLES = 2000


@dataclass(frozen=True, slots=True, kw_only=True)
class FingerPad:
    """Gripping face of a finger, given by a box behind it whose z axis points to the other finger.

    Attributes:
        finger: "left" or "right".
        body: Index into `RobotModel.body_names`.
        T_body_pad: Pose of the box (4, 4), [m].
        half_extents: Half of the side lengths of the box (3,), [m].
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
        """Center of the box (3,), body frame, [m]."""
        return self.T_body_pad[:3, 3]

    @property
    def face_body(self) -> Array:
        """Center of the face towards the other finger (3,), body frame, [m]."""
        return self.center_body + self.half_extents[2] * self.normal_body


@dataclass(frozen=True, slots=True, kw_only=True)
class HandDrive:
    """Actuation of a gripper.

    Attributes:
        driver: Finger joint to which the gripper value refers.
        driver_range: Values of this joint at gripper 0 and 1, [rad] or [m].
        actuator: Name of the actuator that closes the gripper.
        control_range: Controls of the actuator at gripper 0 and 1.
    """

    driver: str
    driver_range: tuple[float, float]
    actuator: str
    control_range: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotMesh:
    """One visual mesh of the robot.

    Attributes:
        body: Index into `RobotModel.body_names`.
        vertices_body: Vertices (V, 3), body frame, [m].
        faces: Vertex indices (F, 3).
        color_srgb: Color (3,), sRGB 0..1.
    """

    body: int
    vertices_body: Annotated[Array, "_ 3"]
    faces: Annotated[NDArray[np.int64], "_ 3"]
    color_srgb: Vector3

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotModel:
    """Arm and gripper as one kinematic model of J arm joints and B bodies.

    Attributes:
        name: Name of the robot.
        joint_names: Names of the J arm joints, in the order of all `joints` arguments.
        body_names: Names of the B bodies in MuJoCo's order without the world: body b is MuJoCo's b + 1.
        joint_limits: Lower and upper limits (J, 2), [rad] or [m].
        slides: Mask (J,) of the prismatic arm joints.
        gripper_table: Finger joints as a function of the gripper value, from 0 (open) to 1 (closed).
        meshes: Visual meshes.
        pads: Left and right pad; empty for an arm without gripper.
        pad_geoms: Names of the colliding geoms of each finger, by side.
        drive: Actuation of the gripper; None for an arm without gripper.
        hand_bodies: Names of the gripper's bodies, which are the descendants of the last arm body.
        ee_site: Name of the site of the end effector, between the pads.
        cameras: Mounted cameras by name: index of the body, and the camera with the body frame as its world frame.
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
    cameras: Mapping[str, tuple[int, Camera]]
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
        """Copy the editable MuJoCo description: radians, dense Jacobian, elliptic cones, impratio 10.

        Without `visual`, it has no visual geoms and compiles ten times faster.
        """
        return (self._full if visual else self._bare).copy()

    def qpos(self, joints: ArrayLike, gripper: ArrayLike) -> Array:
        """Compute the generalized positions (T, nq) of the robot, with finger joints from `gripper_table`.

        Args:
            joints: Arm joints (T, J), [rad] or [m].
            gripper: Gripper values (T,), from 0 (open) to 1 (closed); values outside are clipped.
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
        """Compute the poses T_world_body (T, B, 4, 4) of all bodies; see `qpos` for the arguments."""
        return body_poses(self._model, self.qpos(joints, gripper))[:, 1:]

    def camera_paths(self, joints: ArrayLike, gripper: ArrayLike) -> dict[str, CameraPath]:
        """Compute the poses of the mounted cameras in T frames, by name; see `qpos` for the arguments."""
        Ts = self.link_poses(joints, gripper)
        return {
            name: CameraPath(camera=camera, Ts_world_cam=Ts[:, body] @ camera.T_world_cam)
            for name, (body, camera) in self.cameras.items()
        }

    def pad_distances(self, gripper: ArrayLike) -> Array:
        """Compute the distances (T,) between the faces of both pads for gripper values (T,), [m]; empty without pads."""
        by_finger = {pad.finger: pad for pad in self.pads}
        if set(by_finger) != {"left", "right"}:
            return np.zeros(0)
        left, right = by_finger["left"], by_finger["right"]
        values = np.atleast_1d(np.asarray(gripper, np.float64))
        poses = self.link_poses(np.zeros((len(values), len(self.joint_names))), values)
        between = apply(poses[:, right.body], right.face_body) - apply(poses[:, left.body], left.face_body)
        return np.einsum("ti,ti->t", between, poses[:, left.body, :3, :3] @ left.normal_body)

    def ee_poses(self, joints: ArrayLike) -> Array:
        """Compute the poses T_world_ee (T, 4, 4) of the end effector for joints (T, J), [rad] or [m]."""
        return site_poses(self._model, self.qpos(joints, 0.0), self.ee_site)


def body_poses(model: mujoco.MjModel, states: Array) -> Array:
    """Compute the poses T_world_body (K, B, 4, 4) of all bodies, including the world, for states (K, nq)."""
    found = [(data.xpos.copy(), data.xquat.copy()) for data in _pose_states(model, states)]
    positions, quats = (np.array(part) for part in zip(*found, strict=True))
    return transform(matrix_from_quat(quats), positions)


def site_poses(model: mujoco.MjModel, states: Array, site: str) -> Array:
    """Compute the poses T_world_site (K, 4, 4) of a site for states (K, nq)."""
    found = [
        (data.site(site).xmat.reshape(3, 3).copy(), data.site(site).xpos.copy())
        for data in _pose_states(model, states)
    ]
    rotations, positions = (np.array(part) for part in zip(*found, strict=True))
    return transform(rotations, positions)


def _pose_states(model: mujoco.MjModel, states: Array) -> Iterator[mujoco.MjData]:
    data = mujoco.MjData(model)
    for row in states:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        yield data


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotConfiguration:
    """A robot with joints (J,), [rad] or [m], and a gripper value 0..1, for example those of the scan."""

    robot: RobotModel
    joints: Annotated[Array, "_"]
    gripper: float

    __post_init__ = freeze_arrays

    def points_world(self, count: int = 3000) -> Array:
        """Select about `count` vertices (V, 3) of the robot's meshes, world frame, [m]."""
        poses = self.robot.link_poses(self.joints[None], self.gripper)[0]
        total = sum(len(mesh.vertices_body) for mesh in self.robot.meshes)
        step = max(1, total // count)
        return np.concatenate([apply(poses[m.body], m.vertices_body[::step]) for m in self.robot.meshes])

    def surface_world(self, count: int, rng: np.random.Generator) -> Array:
        """Sample points (count, 3) uniformly on the surface of the robot, world frame, [m]."""
        poses = self.robot.link_poses(self.joints[None], self.gripper)[0]
        corners = [apply(poses[m.body], m.vertices_body)[m.faces] for m in self.robot.meshes]
        return sample_triangles(np.concatenate(corners), count, rng)

    @property
    def ee_world(self) -> Array:
        """End effector position (3,), world frame, [m]."""
        return self.robot.ee_poses(self.joints[None])[0, :3, 3]

    def segments(self) -> NDArray[np.int64]:
        """Count the arm joints that move each body (B,): 0 for the base, J for the gripper.

        Not checked: that the arm is a single chain.
        """
        return self._rotate_joints_once()[1]

    def turns(self, points: Array, bodies: NDArray[np.integer]) -> Array:
        """Compute the derivatives (C, J, 3) of points on bodies with respect to each joint, world frame, [m/rad].

        Args:
            points: Points (C, 3), world frame, [m].
            bodies: Index of the body of each point (C,).
        """
        motions, segments = self._rotate_joints_once()
        moves = np.einsum("jab,cb->cja", motions[:, :3, :3], points) + motions[:, :3, 3]
        behind = segments[bodies][:, None] > np.arange(len(motions))
        return np.asarray(moves * behind[..., None], np.float64)

    def _rotate_joints_once(self) -> tuple[Array, NDArray[np.int64]]:
        rows = np.tile(self.joints, (len(self.joints) + 1, 1))
        rows[1:] += _TURN_RAD * np.eye(len(self.joints))
        poses = self.robot.link_poses(rows, np.full(len(rows), self.gripper))
        motions = poses[1:] @ np.linalg.inv(poses[:1])
        moved = np.abs(motions - np.eye(4)).max((-1, -2)) > 0.01 * _TURN_RAD
        last = np.array([int(np.flatnonzero(row)[-1]) if row.any() else 0 for row in moved])
        fields = (motions[np.arange(len(last)), last] - np.eye(4)) / _TURN_RAD
        return fields, moved.sum(0)


def visual_meshes(model: mujoco.MjModel) -> tuple[RobotMesh, ...]:
    """Triangulate the visible geoms of all bodies, including primitive shapes."""
    meshes = []
    for geom in np.flatnonzero(find_visible_geoms(model)):
        surface = geom_surface(model, int(geom))
        if surface is None:
            continue
        material = model.geom_matid[geom]
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
        body, (vertices, faces) = int(model.geom_bodyid[geom]) - 1, surface
        meshes.append(RobotMesh(body=body, vertices_body=vertices, faces=faces, color_srgb=rgba[:3]))
    return tuple(meshes)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach:
    """Sphere that contains the workspace of an arm.

    Attributes:
        shoulder_world: Center (3,), world frame, [m].
        reach_m: Largest distance of the end effector from the center.
    """

    shoulder_world: Vector3
    reach_m: float

    __post_init__ = freeze_arrays


def longest_reach(robot: RobotModel) -> Reach:
    """Estimate the workspace sphere of an arm from random configurations.

    The center lies on a vertical line through the median of the end effector positions, at the height that minimizes the
    distance to the farthest position. For most arms, this is the shoulder.
    """
    rng = np.random.default_rng(0)
    low, high = np.clip(robot.joint_limits, -np.pi, np.pi).T
    joints = rng.uniform(low, high, (_REACH_SAMPLES, len(low)))
    points = robot.ee_poses(joints)[:, :3, 3]
    foot = float(robot.link_poses(joints[:1], 0.0)[0, 0, 2, 3])
    heights = foot + np.linspace(0.0, 0.5, 26)
    middle = np.median(points[:, :2], axis=0)
    farthest = [
        float(np.linalg.norm(points - np.array([middle[0], middle[1], z]), axis=1).max()) for z in heights
    ]
    best = int(np.argmin(farthest))
    return Reach(shoulder_world=np.array([middle[0], middle[1], heights[best]]), reach_m=farthest[best])
