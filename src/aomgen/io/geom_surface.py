"""Selection of the visible geoms of a MuJoCo model, and triangle meshes of geoms and primitive shapes."""

# MuJoCo has no type stubs, so its classes are unknown to the type checker.
# pyright: reportUnknownParameterType=false

from typing import Final, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from aomgen.core.transforms import matrix_from_quat
from aomgen.core.values import Array

# Number of vertices of the polygon that replaces a circle; its edges are up to 0.5 % of the radius inside the circle.
SIDES = 32
# MuJoCo shows geoms of groups below this number by default; robot models put collision shapes into the other groups.
SHOWN_GROUPS = 3
Shape = Literal["box", "sphere", "ellipsoid", "capsule", "cylinder", "cone"]
_SHAPES: Final[dict[int, Shape]] = {
    mujoco.mjtGeom.mjGEOM_BOX.value: "box",
    mujoco.mjtGeom.mjGEOM_SPHERE.value: "sphere",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID.value: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_CAPSULE.value: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER.value: "cylinder",
}


def find_colliding_geoms(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return a mask (G,) of the geoms that take part in contacts."""
    return (model.geom_contype != 0) | (model.geom_conaffinity != 0)


def find_visible_geoms(
    model: mujoco.MjModel, colliding: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Return a mask (G,) of the visible geoms.

    These are the geoms of shown groups that take part in no contacts. If a body has no such geom, its colliding geoms in
    shown groups are visible, unless the model separates visual and collision geoms into different groups.

    Args:
        model: Compiled model.
        colliding: Mask (G,) of the geoms that take part in contacts; by default that of the model.
    """
    colliding = find_colliding_geoms(model) if colliding is None else colliding
    ours = (model.geom_bodyid > 0) & (model.geom_rgba[:, 3] > 0)
    shown = ours & (model.geom_group < SHOWN_GROUPS)
    visual = shown & ~colliding
    # If no group holds both visual and colliding geoms, the model separates them by group.
    apart = visual.any() and not set(model.geom_group[visual]) & set(model.geom_group[ours & colliding])
    if apart:
        return visual
    bare = ~np.isin(model.geom_bodyid, model.geom_bodyid[visual])
    return visual | (shown & colliding & bare)


def geom_surface(model: mujoco.MjModel, geom: int) -> tuple[Array, NDArray[np.int64]] | None:
    """Compute the triangle mesh of a geom.

    Args:
        model: Compiled model.
        geom: Index of the geom.

    Returns:
        Vertices (V, 3), [m], in the frame of the geom's body, and faces (F, 3), counter-clockwise as seen from outside; None for
        planes and height fields.
    """
    if int(model.geom_type[geom]) == mujoco.mjtGeom.mjGEOM_MESH:
        vertices, faces = _mesh(model, int(model.geom_dataid[geom]))
    else:
        shape = _SHAPES.get(int(model.geom_type[geom]))
        if shape is None:
            return None
        vertices, faces = hull_surface(outer_points(shape, model.geom_size[geom]))
    R = matrix_from_quat(model.geom_quat[geom])
    return vertices @ R.T + model.geom_pos[geom], faces


def _mesh(model: mujoco.MjModel, mesh: int) -> tuple[Array, NDArray[np.int64]]:
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    first, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    stored = model.mesh_vert[start : start + count]
    # This equals `numpy.unique` along an axis, but is six times faster.
    order = np.lexsort(stored.T[::-1])
    is_new = np.append(True, (np.diff(stored[order], axis=0) != 0).any(1))
    index = np.empty(count, np.int64)
    index[order] = np.cumsum(is_new) - 1
    return stored[order[is_new]].astype(np.float64), index[model.mesh_face[first : first + faces]]


def outer_points(kind: Shape, size: Array) -> Array:
    """Compute points (N, 3) whose convex hull approximates a primitive shape.

    Args:
        kind: Kind of the shape.
        size: Half extents of a box or ellipsoid (3,); radius and, along z, half height of other shapes; [m].
    """
    angles = np.arange(SIDES) * 2 * np.pi / SIDES
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(SIDES)], 1)
    heights = np.linspace(-np.pi / 2, np.pi / 2, SIDES // 2)[:, None, None]
    up = np.array([0.0, 0.0, 1.0])
    ball = (ring * np.cos(heights) + up * np.sin(heights)).reshape(-1, 3)
    if kind == "box":
        return np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
    if kind == "sphere":
        return ball * size[0]
    if kind == "ellipsoid":
        return ball * size
    if kind == "capsule":
        return np.concatenate([ball * size[0] + up * size[1], ball * size[0] - up * size[1]])
    if kind == "cone":
        return np.concatenate([ring * size[0] - up * size[1], [up * size[1]]])
    return np.concatenate([ring * size[0] + up * size[1], ring * size[0] - up * size[1]])


def hull_surface(points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Compute the vertices (V, 3) and outward faces (F, 3) of the convex hull of points (N, 3)."""
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("fi,fi->f", normals, hull.equations[:, :3]) < 0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    used, kept = np.unique(faces, return_inverse=True)
    return points[used], kept.reshape(-1, 3).astype(np.int64)
