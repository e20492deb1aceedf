"""Sampling of a gripper's surface, assignment of its points to fingers, and detection of the fingers' gripping faces."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import qmc

from aomgen.core.mesh import face_normals_areas
from aomgen.core.transforms import apply, invert, transform
from aomgen.core.values import Array, freeze_arrays
from aomgen.io.geom_surface import find_visible_geoms, geom_surface
from aomgen.robots.gripper import MIN_TRAVEL_M
from aomgen.robots.reading import ArmChain, ancestors
from aomgen.robots.robot import RobotModel, body_poses

PALM = "palm"
# Number of sample points on a gripper; on one with two fingers, they are about 3 mm apart.
POINTS = 12000
# A body whose motion relative to the palm is at most this while the gripper closes belongs to the palm, [m].
_STILL_M = 1e-4
# Smallest approach of a pair of fingers, as a share of the largest approach of all pairs.
TRAVEL_SHARE = 0.7
# Depth of the contact zone of closing fingers, measured from their first contact, [m]; it allows for the compliance of rubber.
SOFT_M = 0.002
# Cosine of the largest angle (45 degrees) between the normals of a face and the direction to the other finger, and smallest
# number of sample points of a face.
FACING, MIN_FACE_POINTS = 0.7, 12
# Smallest half side length of the box behind a face, [m]; less than half of the thickness of any finger.
HALF_THICKNESS_M = 0.002

# Result of `sample_hand`.
Skins = Mapping[int, tuple[Array, Array]]


@dataclass(frozen=True, slots=True, kw_only=True)
class HandSurface:
    """Points on the whole surface of a gripper.

    Attributes:
        points_body: Points (N, 3), each in the frame of its body, [m].
        normals_body: Outward unit normals (N, 3), each in the frame of its body.
        bodies: Index of each point's body (N,) in `RobotModel.body_names`.
        fingers: Finger of each point (N,): "left", "right" or "palm".
    """

    points_body: Annotated[Array, "N 3"]
    normals_body: Annotated[Array, "N 3"]
    bodies: Annotated[NDArray[np.int64], "N"]
    fingers: NDArray[np.str_]

    __post_init__ = freeze_arrays

    def pose(self, Ts_to_body: Array) -> tuple[Array, Array]:
        """Transform points and normals (N, 3) to the frame in which the poses (B, 4, 4) of all bodies are given."""
        Ts = Ts_to_body[self.bodies]
        points = np.einsum("nij,nj->ni", Ts[:, :3, :3], self.points_body) + Ts[:, :3, 3]
        return points, np.einsum("nij,nj->ni", Ts[:, :3, :3], self.normals_body)


def hand_surface(robot: RobotModel) -> HandSurface:
    """Sample the visible surface of the gripper; the result has no points for an arm without gripper.

    Not checked: that the meshes are closed. Points inside the gripper do no harm, as they are never nearest to an object.
    """
    sides = _sides(robot)
    meshes = [mesh for mesh in robot.meshes if mesh.body in sides]
    if not meshes:
        none = np.zeros((0, 3))
        bodies, fingers = np.zeros(0, np.int64), np.zeros(0, np.str_)
        return HandSurface(points_body=none, normals_body=none, bodies=bodies, fingers=fingers)
    corners = np.concatenate([mesh.vertices_body[mesh.faces] for mesh in meshes]).reshape(-1, 3)
    points, normals, chosen = _sample(corners, np.arange(len(corners)).reshape(-1, 3))
    bodies = np.repeat([mesh.body for mesh in meshes], [len(mesh.faces) for mesh in meshes])[chosen]
    fingers = np.array([sides[int(body)] for body in bodies], np.str_)
    return HandSurface(points_body=points, normals_body=normals, bodies=bodies, fingers=fingers)


def _sides(robot: RobotModel) -> dict[int, str]:
    """Assign each gripper body that moves while the gripper closes to the finger with the nearest pad, others to the palm."""
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


def sample_hand(model: mujoco.MjModel, chain: ArmChain) -> dict[int, tuple[Array, Array]]:
    """Sample the surface of each group of rigidly connected gripper bodies.

    Only visible geoms are sampled if the group has any.

    Returns:
        Points (N, 3), [m], and outward normals (N, 3), in the frame of the group's root body, by the id of this body.
    """
    shown = find_visible_geoms(model)
    Ts = body_poses(model, model.qpos0[None])[0]
    bodies = (chain.last_body, *chain.hand_bodies)
    result = {}
    for root in sorted({int(model.body_weldid[body]) for body in bodies} & set(bodies)):
        geoms = np.flatnonzero(model.body_weldid[model.geom_bodyid] == root)
        meshes = []
        for geom in [g for g in geoms if shown[g]] or geoms:
            surface = geom_surface(model, int(geom))
            if surface is not None:
                meshes.append((apply(invert(Ts[root]) @ Ts[model.geom_bodyid[geom]], surface[0]), surface[1]))
        if meshes:
            vertices = np.concatenate([corners for corners, _ in meshes])
            first = np.cumsum([0, *(len(corners) for corners, _ in meshes)])
            faces = np.concatenate([part + start for (_, part), start in zip(meshes, first, strict=False)])
            points, normals, _ = _sample(vertices, faces)
            result[root] = points, normals
    return result


def _sample(vertices: Array, faces: NDArray[np.int64]) -> tuple[Array, Array, NDArray[np.int64]]:
    """Sample points (N, 3) at equal steps of the surface area, and return them with their normals (N, 3) and faces (N,).

    The center of a contact patch is the mean of a few points. Its error is 0.5 to 2 mm with random points, and 0.4 mm with
    this low-discrepancy sequence.
    """
    normals, areas = face_normals_areas(vertices, faces)
    covered = np.cumsum(areas)
    owners = np.searchsorted(covered, (np.arange(POINTS) + 0.5) / POINTS * covered[-1])
    first, second = qmc.Halton(2, scramble=False).random(POINTS + 1)[1:].T
    root = np.sqrt(first)
    weights = np.stack([1 - root, root * (1 - second), root * second], 1)
    return np.einsum("nk,nkj->nj", weights, vertices[faces[owners]]), normals[owners], owners


def find_fingers(
    model: mujoco.MjModel, chain: ArmChain, skins: Skins, Ts: Array
) -> tuple[tuple[int, int], float] | None:
    """Find the pair of bodies that are the fingers.

    Among the pairs that approach each other most, the pair with the smallest distance is chosen. If only one jaw moves, the
    palm is the other finger.

    Args:
        model: Compiled model of the robot.
        chain: Joints and bodies of the arm and the gripper.
        skins: Surface samples from `sample_hand`.
        Ts: Poses (K, B, 4, 4) of all bodies from one end of the fingers' stroke to the other.

    Returns:
        Ids of the two root bodies, and the distance by which they approach each other, [m], negative if they separate; None
        if no pair moves by at least `MIN_TRAVEL_M`.
    """
    palm = int(model.body_weldid[chain.last_body])
    branch = {body: _branch(model, body, palm) for body in skins if body != palm}
    pairs = [(a, b) for a, b in combinations(branch, 2) if branch[a] != branch[b]]
    if not pairs:
        pairs = [(body, palm) for body in branch if palm in skins]
    found = []
    for a, b in pairs:
        before, after = (_distances(skins, T, a, b) for T in (Ts[0], Ts[-1]))
        nearer = before - after
        far = int(np.argmax(np.abs(nearer)))
        moving = nearer * np.sign(nearer[far]) >= 0.5 * abs(nearer[far])
        gap = np.minimum(before, after)[moving].min()
        found.append((float(gap), float(nearer[far]), (a, b)))
    most = max((abs(approach_m) for _, approach_m, _ in found), default=0.0)
    if not most >= MIN_TRAVEL_M:
        return None
    wide = [item for item in found if abs(item[1]) >= TRAVEL_SHARE * most]
    _, approach_m, pair = min(wide, key=lambda item: item[0])
    return pair, approach_m


def _branch(model: mujoco.MjModel, body: int, palm: int) -> int:
    """Find the child of the palm whose subtree contains a body."""
    line = [body, *ancestors(model, body)]
    return next((b for b in line if model.body_weldid[model.body_parentid[b]] == palm), line[-1])


def _distances(skins: Skins, Ts: Array, a: int, b: int) -> Array:
    """Compute the distance of each sample point of a (N,) from the nearest one of b, [m]."""
    (points_a, _), (points_b, _) = skins[a], skins[b]
    return cKDTree(points_b).query(apply(invert(Ts[b]) @ Ts[a], points_a))[0]


def find_contact_row(skins: Skins, Ts: Array, pair: tuple[int, int]) -> int:
    """Return the index of the first of K states, from open to closed, whose finger distance is about the smallest one."""
    a, b = pair
    moving = _moving(skins, Ts, a, b)
    gaps = np.array([_distances(skins, T, a, b)[moving].min() for T in Ts])
    return int(np.flatnonzero(gaps <= gaps.min() + SOFT_M / 4)[0])


def _moving(skins: Skins, Ts: Array, a: int, b: int) -> NDArray[np.bool_]:
    """Return a mask (N,) of the sample points of a that approach b by more than half of the largest approach."""
    nearer = _distances(skins, Ts[0], a, b) - _distances(skins, Ts[-1], a, b)
    return nearer > 0.5 * nearer.max()


def find_face(skins: Skins, Ts: Array, row: int, a: int, b: int) -> tuple[Array, Array] | None:
    """Find the face of finger a that meets finger b.

    Args:
        skins: Surface samples from `sample_hand`.
        Ts: Poses (K, B, 4, 4) of all bodies from open to closed.
        row: Index of the state of contact; see `find_contact_row`.
        a: Id of the finger's root body.
        b: Id of the other finger's root body.

    Returns:
        Pose (4, 4) of the box behind the face, in the frame of a with z towards b, and its half extents (3,), [m]; None if no
        part of the surface is directed towards b.
    """
    points, normals = skins[a]
    earlier = max(row - max(len(Ts) // 8, 1), 0)
    near = _distances(skins, Ts[row], a, b)
    moving = _moving(skins, Ts, a, b)
    middle = points[moving][np.argsort(near[moving])[:MIN_FACE_POINTS]].mean(0)
    # `towards` points to the earlier position, in the frame of a, of the point of b that touches a in the state of contact.
    T_a_a = invert(Ts[earlier, a]) @ Ts[earlier, b] @ invert(Ts[row, b]) @ Ts[row, a]
    towards = apply(T_a_a, middle) - middle
    length = float(np.linalg.norm(towards))
    if not length > 0:
        return None
    looking = moving & (normals @ (towards / length) > FACING)
    face = looking & (near <= near[looking].min(initial=np.inf) + SOFT_M)
    if not face.sum() >= MIN_FACE_POINTS:
        return None
    return _box(points[face], normals[face].mean(0))


def _box(points: Array, normal: Array) -> tuple[Array, Array]:
    """Compute the pose (4, 4) and half extents (3,) of the box behind a face, with sides along the body's axes if possible."""
    z = normal / np.linalg.norm(normal)
    axis = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = axis - (axis @ z) * z
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], 1)
    low, high = np.quantile(points @ R, [0.02, 0.98], axis=0)
    middle = np.array([*(low + high)[:2] / 2, high[2] - HALF_THICKNESS_M])
    half = np.array([*np.maximum((high - low)[:2] / 2, HALF_THICKNESS_M), HALF_THICKNESS_M])
    return transform(R, R @ middle), half
