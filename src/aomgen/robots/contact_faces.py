"""The two fingers of a hand and the faces with which they hold, found from its shape and motion.

The fingers are the two bodies that come closest of those that move most towards each other; a
gripper with one moving jaw holds against its own palm.
"""

from dataclasses import dataclass
from itertools import combinations

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.transforms import apply, invert, matrix_from_quat, transform
from aomgen.core.values import Array
from aomgen.robots.arm_chain import ArmChain
from aomgen.robots.geom_meshes import geom_surface

# Sample points on all fingers together; a pad has far more than MIN_FACE_POINTS of them.
POINTS = 6000
# A pair of fingers moves at least this share of what the pair that moves most does.
TRAVEL_SHARE = 0.7
# What touches when the fingers close lies within this of the first contact: rubber gives way, [m].
SOFT_M = 0.002
# Less than this between open and closed is no gripper, [m].
MIN_TRAVEL_M = 0.004
# A face looks at the other finger when it is turned less than 45 degrees away.
FACING = 0.7
# Least half size of the box behind a face, [m]; less than the half thickness of any finger.
HALF_THICKNESS_M = 0.002
# Fewer sample points are no face.
MIN_FACE_POINTS = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceSamples:
    """Points (N, 3) and outward normals (N, 3) all over bodies that are rigidly joined, root's frame."""

    points: Array
    normals: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class FingerFace:
    """Where a finger holds: a box whose z axis points to the other finger.

    Attributes:
        body: Id of the body that carries it.
        T_body_pad: Pose of the box (4, 4); its face is at +z.
        half_extents: (3,), [m].
    """

    body: int
    T_body_pad: Array
    half_extents: Array


def surfaces(
    model: mujoco.MjModel, bodies: tuple[int, ...], shown: NDArray[np.bool_]
) -> dict[int, SurfaceSamples]:
    """The surface of every rigid group of bodies, by the id of its root; what is seen if anything is.

    Args:
        model: Of the robot.
        bodies: Ids.
        shown: (G,) geoms that are seen.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    Ts = _poses(data)
    rng = np.random.default_rng(0)
    result = {}
    for root in sorted({int(model.body_weldid[body]) for body in bodies} & set(bodies)):
        geoms = np.flatnonzero(model.body_weldid[model.geom_bodyid] == root)
        geoms = [g for g in geoms if shown[g]] or list(geoms)
        vertices, faces, offset = [], [], 0
        for geom in geoms:
            surface = geom_surface(model, int(geom))
            if surface is not None:
                T_root_body = invert(Ts[root]) @ Ts[model.geom_bodyid[geom]]
                vertices.append(apply(T_root_body, surface[0]))
                faces.append(surface[1] + offset)
                offset += len(surface[0])
        if vertices:
            corners, triangles = np.concatenate(vertices), np.concatenate(faces)
            points, owners, _ = sample_surface(corners, triangles, POINTS, rng)
            normals = face_normals_areas(corners, triangles)[0][owners]
            result[root] = SurfaceSamples(points=points, normals=normals)
    return result


def poses_at(model: mujoco.MjModel, qpos: Array) -> Array:
    """Poses T_world_body (K, B, 4, 4) of all bodies, world included, for states (K, nq)."""
    data = mujoco.MjData(model)
    result = []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        result.append(_poses(data))
    return np.array(result)


def _poses(data: mujoco.MjData) -> Array:
    return transform(matrix_from_quat(data.xquat), data.xpos)


@dataclass(frozen=True, slots=True, kw_only=True)
class Travel:
    """How two bodies approach each other between two states of the hand.

    Attributes:
        bodies: Root ids of the fingers.
        way_m: How much nearer they come from the first state to the second; negative if farther.
        gap_m: What is left between them where they are nearest.
    """

    bodies: tuple[int, int]
    way_m: float
    gap_m: float


def find_finger_travel(
    model: mujoco.MjModel, chain: ArmChain, skins: dict[int, SurfaceSamples], first: Array, second: Array
) -> Travel | None:
    """The pair of bodies that are the fingers, judged between two states; None if nothing moves.

    Args:
        model: Of the robot.
        chain: Its hand.
        skins: From `surfaces`.
        first, second: States (nq,).
    """
    Ts = poses_at(model, np.stack([first, second]))
    palm = int(model.body_weldid[chain.last_body])
    branch = {body: _branch(model, body, palm) for body in skins if body != palm}
    pairs = [(a, b) for a, b in combinations(branch, 2) if branch[a] != branch[b]]
    if not pairs:
        pairs = [(body, palm) for body in branch if palm in skins]
    found = []
    for a, b in pairs:
        nearer = _distances(skins, Ts[0], a, b, 10) - _distances(skins, Ts[1], a, b, 10)
        far = int(np.argmax(np.abs(nearer)))
        moving = nearer * np.sign(nearer[far]) >= 0.5 * abs(nearer[far])
        near_state = Ts[1] if nearer[far] > 0 else Ts[0]
        gap = float(_distances(skins, near_state, a, b, 10)[moving].min())
        found.append(Travel(bodies=(a, b), way_m=float(nearer[far]), gap_m=gap))
    most = max((abs(travel.way_m) for travel in found), default=0.0)
    if not most >= MIN_TRAVEL_M:
        return None
    return min((t for t in found if abs(t.way_m) >= TRAVEL_SHARE * most), key=lambda t: t.gap_m)


def _branch(model: mujoco.MjModel, body: int, palm: int) -> int:
    """The child of the palm through which a body hangs on it."""
    while int(model.body_weldid[model.body_parentid[body]]) != palm and model.body_parentid[body]:
        body = int(model.body_parentid[body])
    return body


def _distances(skins: dict[int, SurfaceSamples], Ts: Array, a: int, b: int, every: int = 1) -> Array:
    """Distance of a's points (N / every,) to b, [m]."""
    T_b_a = invert(Ts[b]) @ Ts[a]
    return cKDTree(skins[b].points).query(apply(T_b_a, skins[a].points[::every]))[0]


def find_contact_row(skins: dict[int, SurfaceSamples], Ts: Array, pair: tuple[int, int]) -> int:
    """The first state (of K, opening to closing) in which the fingers touch; else the nearest one."""
    a, b = pair
    moving = _moving(skins, Ts, a, b)[::10]
    gaps = np.array([_distances(skins, T, a, b, 10)[moving].min() for T in Ts])
    touching = np.flatnonzero(gaps <= gaps.min() + SOFT_M / 4)
    return int(touching[0])


def _moving(skins: dict[int, SurfaceSamples], Ts: Array, a: int, b: int) -> NDArray[np.bool_]:
    """Points of a that come nearer to b by at least half of what any does."""
    nearer = _distances(skins, Ts[0], a, b) - _distances(skins, Ts[-1], a, b)
    return nearer > 0.5 * nearer.max()


def holding_face(skins: dict[int, SurfaceSamples], Ts: Array, row: int, a: int, b: int) -> FingerFace | None:
    """The face of finger a that meets finger b; None when no side of it looks there.

    Args:
        skins: From `surfaces`.
        Ts: Poses (K, B, 4, 4) from open to closed.
        row: State in which the fingers are closest.
        a, b: Root ids.
    """
    skin = skins[a]
    earlier = max(row - max(len(Ts) // 8, 1), 0)
    near = _distances(skins, Ts[row], a, b)
    moving = _moving(skins, Ts, a, b)
    middle = skin.points[moving][np.argsort(near[moving])[:MIN_FACE_POINTS]].mean(0)
    # What lies against a at the end, carried by b to where it was before.
    T_a_a = invert(Ts[earlier, a]) @ Ts[earlier, b] @ invert(Ts[row, b]) @ Ts[row, a]
    towards = apply(T_a_a, middle) - middle
    length = float(np.linalg.norm(towards))
    if not length > 0:
        return None
    looking = moving & (skin.normals @ (towards / length) > FACING)
    if not looking.any():
        return None
    face = looking & (near <= near[looking].min() + SOFT_M)
    if not face.sum() >= MIN_FACE_POINTS:
        return None
    return _box(a, skin.points[face], skin.normals[face].mean(0))


def _box(body: int, points: Array, normal: Array) -> FingerFace:
    """The box behind a face, its sides along the body's axes as far as the normal allows."""
    z = normal / np.linalg.norm(normal)
    axis = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = axis - (axis @ z) * z
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], 1)
    local = points @ R
    low, high = np.quantile(local, [0.02, 0.98], axis=0)
    middle = np.array([*(low + high)[:2] / 2, high[2] - HALF_THICKNESS_M])
    half = np.array([*np.maximum((high - low)[:2] / 2, HALF_THICKNESS_M), HALF_THICKNESS_M])
    return FingerFace(body=body, T_body_pad=transform(R, R @ middle), half_extents=half)
