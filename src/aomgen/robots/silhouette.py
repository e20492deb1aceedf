"""Exact pinhole images of the posed robot: which body covers each pixel, and how far away."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.assets.mjcf import VISUAL_GROUP, add_visual_geom
from aomgen.core.camera import Camera
from aomgen.core.recording import JointLog
from aomgen.core.values import Array
from aomgen.robots.geom_meshes import RobotMesh
from aomgen.robots.model_renderer import ModelRenderer
from aomgen.robots.robot import RobotModel

# Outlines move by some tenths of a millimetre, and drawing is several times faster.
CELL_M: Final = 0.001
# Masks are compared at a few hundred pixels, where finer meshes would not be seen, [m].
MASK_CELL_M: Final = 0.003
# Robot masks (T, height, width) at log times (T,), width and height in px.
MasksAt = Callable[[Array, int, int], NDArray[np.bool_]]


class SilhouetteRenderer(ModelRenderer):
    """Draws one robot; holds an OpenGL context until closed. Not thread safe."""

    def __init__(
        self, robot: RobotModel, *, max_width: int = 1920, max_height: int = 1440, cell_m: float = CELL_M
    ) -> None:
        """Create the context.

        Args:
            robot: What is drawn.
            max_width, max_height: Largest image, [px].
            cell_m: How finely the robot's meshes are drawn; see `add_robot_visuals`.

        Raises:
            BackendError: No OpenGL driver works.
        """
        spec = robot.spec(visual=False)
        add_robot_visuals(spec, robot, cell_m)
        spec.visual.quality.offsamples = 0
        model = spec.compile()
        groups = model.geom_group
        shown = VISUAL_GROUP if np.any(groups == VISUAL_GROUP) else int(groups.min())
        super().__init__(model, (max_width, max_height), shown)
        self._robot = robot

    def draw(
        self, camera: Camera, joints: ArrayLike, gripper: float
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Draw the robot with joints (J,), [rad], and gripper 0 open .. 1 closed.

        Returns:
            Body index (H, W) into `robot.body_names`, -1 where there is no robot; and depth along
            the optical axis (H, W) [m], 0 where there is no robot.

        Raises:
            BackendError: The image is larger than the context.
        """
        qpos = self._robot.qpos(np.asarray(joints)[None], gripper)[0]
        bodies, depths = self.draw_values(camera, qpos, self.model.geom_bodyid - 1, nothing=-1)
        return bodies, np.where(bodies >= 0, depths, 0.0).astype(np.float32)


@contextmanager
def robot_masks(robot: RobotModel, camera: Camera, log: JointLog) -> Iterator[MasksAt]:
    """A function that draws robot masks at log times in the demonstration camera; one OpenGL context."""
    with SilhouetteRenderer(
        robot, max_width=camera.width, max_height=camera.height, cell_m=MASK_CELL_M
    ) as renderer:

        def masks_at(times_s: Array, width: int, height: int) -> NDArray[np.bool_]:
            small = camera.resize(width, height)
            joints, gripper = log.at(times_s)
            masks = np.empty((len(times_s), height, width), bool)
            for k, (row, closing) in enumerate(zip(joints, gripper, strict=True)):
                masks[k] = renderer.draw(small, row, float(closing))[0] >= 0
            return masks

        yield masks_at


def add_robot_visuals(spec: mujoco.MjSpec, robot: RobotModel, cell_m: float) -> None:
    """Add simplified visual meshes to a model that holds the robot's bodies without their appearance.

    Drawing time of a software renderer is mostly vertices.

    Args:
        spec: Gets the meshes; holds the robot's bodies.
        robot: Whose meshes are added.
        cell_m: Vertices that share a cell of this size become one; outlines move by a fraction of it.
    """
    for number, (mesh, vertices, faces) in enumerate(_simplify_meshes(robot, cell_m)):
        name = f"looks_{number}"
        item = spec.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.ravel().astype(np.int32))
        item.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        material = spec.add_material(name=name, rgba=[*mesh.color_srgb, 1.0])
        material.specular, material.shininess = 0.4, 0.3
        add_visual_geom(spec.body(robot.body_names[mesh.body]), name)


def _simplify_meshes(robot: RobotModel, cell_m: float) -> list[tuple[RobotMesh, Array, NDArray[np.int64]]]:
    """Every visual mesh with its simplified vertices and faces.

    Meshes of one body are merged by the same cells, so that no cracks open between them.
    Source: Rossignac and Borrel, "Multi-resolution 3D approximations", 1993.
    """
    result = []
    for body in sorted({mesh.body for mesh in robot.meshes}):
        meshes = [mesh for mesh in robot.meshes if mesh.body == body]
        vertices = np.concatenate([mesh.vertices_body for mesh in meshes])
        keys = np.floor(vertices / cell_m).astype(np.int64)
        _, cells, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
        cells = cells.reshape(-1)
        means = np.stack([np.bincount(cells, column) / counts for column in vertices.T], 1)
        offset = 0
        for mesh in meshes:
            faces = cells[mesh.faces + offset]
            offset += len(mesh.vertices_body)
            distinct = np.diff(np.sort(faces, 1), axis=1).min(1) > 0
            used, kept = np.unique(faces[distinct], return_inverse=True)
            if len(used):
                result.append((mesh, means[used], kept.reshape(-1, 3)))
    return result
