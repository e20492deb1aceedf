"""The robot as it stood during the scan: where it is, and how each of its joints would move it."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.core.mesh import sample_surface
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.robots.robot import RobotModel

# Step of the numeric derivative, [rad]: its error is far below a pixel.
_TURN_RAD = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotConfiguration:
    """The robot during the scan: model, joints (J,) [rad] and gripper 0..1."""

    robot: RobotModel
    joints: Annotated[Array, "_"]
    gripper: float

    __post_init__ = freeze_arrays

    def points_world(self, count: int = 3000) -> Array:
        """About `count` vertices (V, 3) of the posed robot, [m]."""
        poses = self.robot.link_poses(self.joints[None], self.gripper)[0]
        total = sum(len(mesh.vertices_body) for mesh in self.robot.meshes)
        step = max(1, total // count)
        return np.concatenate([apply(poses[m.body], m.vertices_body[::step]) for m in self.robot.meshes])

    def surface_world(self, count: int, rng: np.random.Generator) -> Array:
        """Points (count, 3) spread evenly over the surface of the posed robot, [m]."""
        poses = self.robot.link_poses(self.joints[None], self.gripper)[0]
        corners = [apply(poses[m.body], m.vertices_body)[m.faces] for m in self.robot.meshes]
        vertices = np.concatenate(corners).reshape(-1, 3)
        return sample_surface(vertices, np.arange(len(vertices)).reshape(-1, 3), count, rng)[0]

    @property
    def ee_world(self) -> Array:
        """End effector position (3,), [m]."""
        return self.robot.ee_poses(self.joints[None])[0, :3, 3]

    def segments(self) -> NDArray[np.int64]:
        """Number (B,) of arm joints that move each body: 0 = base, J = hand.

        Not checked: the arm is one chain.
        """
        return self._turned()[1]

    def joint_motions(self) -> Array:
        """Velocity fields (J, 4, 4): a joint moves a point p behind it by `M[:3] @ [p, 1]`, [1/rad]."""
        return self._turned()[0]

    def turns(self, points: Array, bodies: NDArray[np.integer]) -> Array:
        """How each joint moves points (C, 3) on bodies (C,): velocities (C, J, 3), [m/rad]."""
        motions, segments = self._turned()
        moves = np.einsum("jab,cb->cja", motions[:, :3, :3], points) + motions[:, :3, 3]
        return np.asarray(
            moves * (segments[bodies][:, None] > np.arange(len(motions)))[..., None], np.float64
        )

    def _turned(self) -> tuple[Array, NDArray[np.int64]]:
        rows = np.tile(self.joints, (len(self.joints) + 1, 1))
        rows[1:] += _TURN_RAD * np.eye(len(self.joints))
        poses = self.robot.link_poses(rows, np.full(len(rows), self.gripper))
        motions = poses[1:] @ np.linalg.inv(poses[:1])
        moved = np.abs(motions - np.eye(4)).max((-1, -2)) > 0.01 * _TURN_RAD
        last = np.array([int(np.flatnonzero(row)[-1]) if row.any() else 0 for row in moved])
        fields = (motions[np.arange(len(last)), last] - np.eye(4)) / _TURN_RAD
        return fields, moved.sum(0)
