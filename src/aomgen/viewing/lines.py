"""Line drawings in the world frame, and their projection into an image."""

from typing import Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from aomgen.core.camera import Camera
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.io.geom_surface import find_colliding_geoms

# Points of a circle, sufficient for the outline of a collider at arm's length.
SIDES: Final = 24
# Edges between faces that meet at a smaller angle are omitted, because the faces approximate one smooth surface, [rad].
SHARP_RAD: Final = 0.6
# Lines are clipped at this depth in front of the camera, [m].
NEAR: Final = 0.02


def project_segments(camera: Camera, segments: ArrayLike) -> Array:
    """Project segments (N, 2, 3), world frame, to pixels (M, 4) x0, y0, x1, y1, clipped in front of the camera."""
    points = apply(camera.T_cam_world, np.asarray(segments, np.float64).reshape(-1, 3)).reshape(-1, 2, 3)
    points = points[(points[..., 2] > NEAR).any(1)]
    a, b = points[:, 0], points[:, 1]
    cut = np.minimum(a[:, 2], b[:, 2]) < NEAR
    share = np.where(cut, (NEAR - a[:, 2]) / np.where(cut, b[:, 2] - a[:, 2], 1.0), 0.0)[:, None]
    crossing = a + share * (b - a)
    a = np.where((cut & (a[:, 2] < NEAR))[:, None], crossing, a)
    b = np.where((cut & (b[:, 2] < NEAR))[:, None], crossing, b)
    ends = [np.stack([camera.fx * p[:, 0] / p[:, 2] + camera.cx, camera.fy * p[:, 1] / p[:, 2] + camera.cy], 1) for p in (a, b)]  # fmt: skip
    return np.concatenate(ends, 1)


def join_points(points: ArrayLike, *, closed: bool = False) -> Array:
    """Create the segments (N - 1, 2, 3) that join points (N, 3) in order; (N, 2, 3) if closed."""
    points = np.asarray(points, np.float64)
    following = np.roll(points, -1, 0)
    return np.stack([points, following], 1)[: None if closed else -1]


def outline_camera(camera: Camera, size: float) -> Array:
    """Create the segments (8, 2, 3) of a camera's viewing pyramid with depth `size`, world frame."""
    u = (np.array([0, camera.width, camera.width, 0]) - camera.cx) / camera.fx
    v = (np.array([0, 0, camera.height, camera.height]) - camera.cy) / camera.fy
    corners = apply(camera.T_world_cam, size * np.stack([u, v, np.ones(4)], 1))
    rays = np.stack([np.repeat(camera.center[None], 4, 0), corners], 1)
    return np.concatenate([rays, join_points(corners, closed=True)])


def outline_geoms(model: mujoco.MjModel) -> list[tuple[int, Array]]:
    """Outline the colliding shapes of a model.

    Returns:
        Index of each shape, and its segments (N, 2, 3) in the frame of the shape.
    """
    meshes = {
        int(number): outline_hull(_mesh_vertices(model, int(number)))
        for number in np.unique(model.geom_dataid[model.geom_type == mujoco.mjtGeom.mjGEOM_MESH])
    }
    found = []
    for geom in np.flatnonzero(find_colliding_geoms(model)):
        # A plain number is not found among the members of the enumeration.
        kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            found.append((int(geom), meshes[int(model.geom_dataid[geom])]))
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
            found.append((int(geom), outline_hull(signs * size)))
        elif kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
            cap = size[0] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
            found.append((int(geom), _outline_tube(float(size[0]), float(size[1]), float(cap))))
        elif kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
            radii = size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else np.repeat(size[0], 3)
            rings = [np.roll(_circle(1.0, 0.0), axis, 1) * radii for axis in range(3)]
            found.append((int(geom), np.concatenate([join_points(ring, closed=True) for ring in rings])))
    return found


def outline_hull(points: Array) -> Array:
    """Create the segments (E, 2, 3) of the sharp edges of the convex hull of points (N, 3)."""
    hull = ConvexHull(points)
    normals, segments = hull.equations[:, :3], []
    for face, (corners, neighbors) in enumerate(zip(hull.simplices, hull.neighbors, strict=True)):
        for k, other in enumerate(neighbors):
            if face < other and normals[face] @ normals[other] < np.cos(SHARP_RAD):
                segments.append(points[np.delete(corners, k)])
    return np.array(segments).reshape(-1, 2, 3)


def _mesh_vertices(model: mujoco.MjModel, number: int) -> Array:
    start, count = model.mesh_vertadr[number], model.mesh_vertnum[number]
    return np.asarray(model.mesh_vert[start : start + count], np.float64)


def _circle(radius: float, height: float) -> Array:
    turns = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
    return np.stack([radius * np.cos(turns), radius * np.sin(turns), np.full(SIDES, height)], 1)


def _outline_tube(radius: float, half: float, cap: float) -> Array:
    """Create two circles, four lines between them along z, and half circles of round caps."""
    rings = [_circle(radius, height) for height in (-half, half)]
    lines = np.stack([rings[0][:: SIDES // 4], rings[1][:: SIDES // 4]], 1)
    parts = [*(join_points(ring, closed=True) for ring in rings), lines]
    if cap:
        turns = np.linspace(0, np.pi, SIDES // 2 + 1)
        for sign in (-1, 1):
            for axis in (0, 1):
                arc = np.zeros((len(turns), 3))
                arc[:, axis] = radius * np.cos(turns)
                arc[:, 2] = sign * (half + cap * np.sin(turns))
                parts.append(join_points(arc))
    return np.concatenate(parts)
