"""What is seen of a robot, as triangles."""

from dataclasses import dataclass
from typing import Annotated

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array, Vector3, freeze_arrays
from aomgen.io.geom_surface import find_visible_geoms, geom_surface


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotMesh:
    """One visual mesh of the robot, in the frame of a body (index into `RobotModel.body_names`), [m]."""

    body: int
    vertices_body: Annotated[Array, "_ 3"]
    faces: Annotated[NDArray[np.int64], "_ 3"]
    color_srgb: Vector3

    __post_init__ = freeze_arrays


def visual_meshes(model: mujoco.MjModel) -> tuple[RobotMesh, ...]:
    """What is seen of every body, triangles of primitive shapes included."""
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
