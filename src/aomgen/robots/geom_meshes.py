"""Surfaces of MuJoCo's geoms as triangles, whatever kind of shape they are."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.core.transforms import matrix_from_quat
from aomgen.core.values import Array

# Round shapes are drawn with this many corners about their axis: 0.5 % of the radius inside the circle.
SIDES = 32
BOX_FACES = np.array([
    [0, 3, 2], [0, 1, 3], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5],
    [2, 7, 6], [2, 3, 7], [0, 6, 4], [0, 2, 6], [1, 7, 3], [1, 5, 7],
])  # fmt: skip


def geom_surface(model: mujoco.MjModel, geom: int) -> tuple[Array, NDArray[np.int64]] | None:
    """Vertices (V, 3) in the frame of the geom's body and faces (F, 3); None for planes and height fields.

    Faces turn counter-clockwise seen from outside.
    """
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    G = mujoco.mjtGeom
    if kind == G.mjGEOM_MESH:
        vertices, faces = _mesh(model, int(model.geom_dataid[geom]))
    elif kind == G.mjGEOM_BOX:
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
        vertices, faces = signs * size, BOX_FACES
    elif kind == G.mjGEOM_SPHERE:
        vertices, faces = _turned(_arc(size[0], 0.0))
    elif kind == G.mjGEOM_ELLIPSOID:
        vertices, faces = _turned(_arc(1.0, 0.0))
        vertices = vertices * size
    elif kind == G.mjGEOM_CAPSULE:
        vertices, faces = _turned(_arc(size[0], size[1]))
    elif kind == G.mjGEOM_CYLINDER:
        radius, half = size[:2]
        vertices, faces = _turned(np.array([[0, -half], [radius, -half], [radius, half], [0, half]]))
    else:
        return None
    R = matrix_from_quat(model.geom_quat[geom])
    return vertices @ R.T + model.geom_pos[geom], faces


def _mesh(model: mujoco.MjModel, mesh: int) -> tuple[Array, NDArray[np.int64]]:
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    first, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices, index = np.unique(model.mesh_vert[start : start + count], axis=0, return_inverse=True)
    return vertices, index.reshape(-1)[model.mesh_face[first : first + faces]].astype(np.int64)


def _arc(radius: float, half_length: float) -> Array:
    """Outline (N, 2) of a capsule from its lower to its upper pole: distance from the axis, height."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, SIDES // 2)
    heights = radius * np.sin(angles) + np.where(angles < 0, -half_length, half_length)
    return np.stack([radius * np.cos(angles), heights], 1)


def _turned(outline: Array) -> tuple[Array, NDArray[np.int64]]:
    """The surface that an outline (N, 2) sweeps about z; its ends lie on the axis."""
    angles = np.arange(SIDES) * 2 * np.pi / SIDES
    ring = np.stack([np.cos(angles), np.sin(angles)], 1)
    inner = outline[1:-1]
    rows = np.concatenate([
        np.repeat(inner[:, :1, None], SIDES, 1) * ring, np.repeat(inner[:, 1:, None], SIDES, 1)
    ], 2)  # fmt: skip
    vertices = np.concatenate([[[0, 0, outline[0, 1]]], rows.reshape(-1, 3), [[0, 0, outline[-1, 1]]]])
    here = np.arange(SIDES)
    there, faces, top = (here + 1) % SIDES, [], len(vertices) - 1
    for row in range(len(inner) - 1):
        a, b = 1 + row * SIDES, 1 + (row + 1) * SIDES
        faces += [np.stack([a + here, a + there, b + there], 1), np.stack([a + here, b + there, b + here], 1)]
    last = 1 + (len(inner) - 1) * SIDES
    faces.append(np.stack([np.zeros_like(here), 1 + there, 1 + here], 1))
    faces.append(np.stack([np.full_like(here, top), last + here, last + there], 1))
    return vertices, np.concatenate(faces)
