"""The robot as it is drawn often: the same shape with a fraction of the triangles."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import add_visual_geom
from aomgen.core.values import Array
from aomgen.robots.robot import RobotMesh, RobotModel


def add_robot_visuals(spec: mujoco.MjSpec, robot: RobotModel, cell_m: float) -> None:
    """Add simplified visual meshes to a model that holds the robot's bodies without their appearance.

    Drawing time of a software renderer is mostly vertices.

    Args:
        spec: Gets the meshes; holds the robot's bodies.
        robot: Whose meshes are added.
        cell_m: Vertices that share a cell of this size become one; outlines move by a fraction of it.
    """
    for number, (mesh, vertices, faces) in enumerate(_simplified_meshes(robot, cell_m)):
        name = f"looks_{number}"
        item = spec.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.ravel().astype(np.int32))
        item.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        material = spec.add_material(name=name, rgba=[*mesh.color_srgb, 1.0])
        material.specular, material.shininess = 0.4, 0.3
        add_visual_geom(spec.body(robot.body_names[mesh.body]), name)


def _simplified_meshes(robot: RobotModel, cell_m: float) -> list[tuple[RobotMesh, Array, NDArray[np.int64]]]:
    """Every visual mesh with its simplified vertices and faces.

    Meshes of one body are merged by the same cells, so that no cracks open between them.
    """
    result = []
    for body in sorted({mesh.body for mesh in robot.meshes}):
        meshes = [mesh for mesh in robot.meshes if mesh.body == body]
        offsets = np.cumsum([0] + [len(mesh.vertices_body) for mesh in meshes])
        means, cells = merge_vertices(np.concatenate([mesh.vertices_body for mesh in meshes]), cell_m)
        for mesh, offset in zip(meshes, offsets, strict=False):
            faces = cells[mesh.faces + offset]
            distinct = np.diff(np.sort(faces, 1), axis=1).min(1) > 0
            used, kept = np.unique(faces[distinct], return_inverse=True)
            if len(used):
                result.append((mesh, means[used], kept.reshape(-1, 3)))
    return result


def merge_vertices(vertices: Array, cell: float) -> tuple[Array, NDArray[np.int64]]:
    """Mean vertex (C, 3) of every occupied cell [m], and the cell (V,) of every vertex.

    Source: Rossignac and Borrel, "Multi-resolution 3D approximations", 1993.
    """
    keys = np.floor(vertices / cell).astype(np.int64)
    _, cells = np.unique(keys, axis=0, return_inverse=True)
    cells = cells.reshape(-1)
    counts = np.bincount(cells)
    return np.stack([np.bincount(cells, column) / counts for column in vertices.T], 1), cells
