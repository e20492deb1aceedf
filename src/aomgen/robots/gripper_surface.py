"""The whole surface of a hand, each point with the finger that it belongs to."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from aomgen.core.mesh import face_normals_areas
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze_arrays
from aomgen.robots.robot import RobotModel

PALM = "palm"
# Points on a whole hand: some 3 mm apart on a two-finger gripper.
POINTS = 12000
# A body that moves less than this against the palm while the hand closes is palm, [m].
_STILL_M = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class HandSurface:
    """Points all over a hand, in the frames of the bodies that carry them.

    Attributes:
        points_body: (N, 3), [m].
        normals_body: Outward unit normals (N, 3).
        bodies: Index of each point's body (N,).
        fingers: Name of each point's finger (N,): that of its pad, or "palm".
    """

    points_body: Annotated[Array, "N 3"]
    normals_body: Annotated[Array, "N 3"]
    bodies: Annotated[NDArray[np.int64], "N"]
    fingers: NDArray[np.str_]

    __post_init__ = freeze_arrays

    def posed(self, Ts_to_body: Array) -> tuple[Array, Array]:
        """Points and normals (N, 3) for poses (B, 4, 4) of all bodies, in the frame of these."""
        Ts = Ts_to_body[self.bodies]
        points = np.einsum("nij,nj->ni", Ts[:, :3, :3], self.points_body) + Ts[:, :3, 3]
        return points, np.einsum("nij,nj->ni", Ts[:, :3, :3], self.normals_body)


def hand_surface(robot: RobotModel) -> HandSurface:
    """Points over everything that is seen of the hand; none for an arm without one.

    Not checked: that the meshes are closed; a point inside the hand is never nearest to a part.
    """
    sides = _sides(robot)
    meshes = [mesh for mesh in robot.meshes if mesh.body in sides]
    if not meshes:
        return HandSurface(
            points_body=np.zeros((0, 3)),
            normals_body=np.zeros((0, 3)),
            bodies=np.zeros(0, np.int64),
            fingers=np.zeros(0, np.str_),
        )
    triangles = np.concatenate([mesh.vertices_body[mesh.faces] for mesh in meshes])
    points, chosen = _spread(triangles, POINTS)
    bodies = np.repeat([mesh.body for mesh in meshes], [len(mesh.faces) for mesh in meshes])[chosen]
    normals, _ = face_normals_areas(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    return HandSurface(
        points_body=points,
        normals_body=normals[chosen],
        bodies=bodies,
        fingers=np.array([sides[int(body)] for body in bodies], np.str_),
    )


def _spread(triangles: Array, count: int) -> tuple[Array, NDArray[np.intp]]:
    """Points (N, 3) over triangles (F, 3, 3) at even steps of their area, and the triangle of each.

    A pushed patch is the mean of few of them: of random ones it is off by 0.5 to 2 mm, of these by 0.4 mm.
    """
    edges = triangles[:, 1:] - triangles[:, :1]
    covered = np.cumsum(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1))
    chosen = np.searchsorted(covered, (np.arange(count) + 0.5) / count * covered[-1])
    first, second = qmc.Halton(2, scramble=False).random(count + 1)[1:].T
    root = np.sqrt(first)
    weights = np.stack([1 - root, root * (1 - second), root * second], 1)
    return np.einsum("nk,nkj->nj", weights, triangles[chosen]), chosen


def _sides(robot: RobotModel) -> dict[int, str]:
    """Finger of every body of the hand: what moves as the hand closes, by the nearer pad."""
    hand = [robot.body_names.index(name) for name in robot.hand_bodies]
    if not robot.pads:
        return dict.fromkeys(hand, PALM)
    joints = np.repeat(robot.joint_limits.clip(-np.pi, np.pi).mean(1)[None], 2, 0)
    T_ee_world = invert(robot.ee_poses(joints)[0])
    opened, closed = T_ee_world @ robot.link_poses(joints, np.array([0.0, 1.0]))
    across = {
        pad.finger: float(apply(opened[pad.body], pad.face_body) @ robot.closing_ee) for pad in robot.pads
    }
    sides = {}
    for body in hand:
        corners = [mesh.vertices_body for mesh in robot.meshes if mesh.body == body] or [np.zeros((1, 3))]
        vertices = np.concatenate(corners)
        moved = np.linalg.norm(apply(closed[body], vertices) - apply(opened[body], vertices), axis=1).max()
        middle = float(apply(opened[body], vertices).mean(0) @ robot.closing_ee)
        nearest = min(across, key=lambda finger: abs(across[finger] - middle))
        sides[body] = nearest if moved > _STILL_M else PALM
    return sides | {pad.body: pad.finger for pad in robot.pads if pad.body in sides}
