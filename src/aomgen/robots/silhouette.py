"""Exact pinhole images of MuJoCo models, and robot silhouettes: geom or body at each pixel, and depth."""

import importlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, Self

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.assets.mjcf import VISUAL_GROUP, add_visual_geom
from aomgen.core.camera import Camera
from aomgen.core.recording import JointLog
from aomgen.core.values import Array
from aomgen.errors import BackendError
from aomgen.robots.robot import RobotMesh, RobotModel

# Near and far plane of the rendering, [m]; the recorded surfaces are between them.
NEAR_M, FAR_M = 0.05, 20.0
# Upper limit of the geoms that `mjv_updateScene` adds by itself: lights and a skybox.
EXTRA_GEOMS: Final = 64
REMEDY = "install libegl1 libegl-mesa0 libgl1-mesa-dri (or libosmesa6), or set MUJOCO_GL to egl or osmesa"


class ModelRenderer:
    """Renderer of one model with MuJoCo's rasterizer. It holds an OpenGL context until it is closed; not thread-safe."""

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int], group: int) -> None:
        """Create a context for images up to `size` (width, height), [px], of a group of geoms.

        Raises:
            BackendError: No OpenGL driver works.
        """
        self.model, self.data, self._size = model, mujoco.MjData(model), size
        model.vis.global_.offwidth, model.vis.global_.offheight = size
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + EXTRA_GEOMS)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[group] = 1
        self._context = offscreen_context(*size)
        self._renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._renderer)
        self._renderer.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR

    def draw_values(
        self, camera: Camera, qpos: ArrayLike, geom_values: NDArray, *, nothing: int
    ) -> tuple[NDArray, NDArray[np.float64]]:
        """Render the value of the geom at each pixel, without light or anti-aliasing.

        Args:
            camera: Pinhole camera, world frame.
            qpos: State (nq,).
            geom_values: Value of each geom of the model (G,).
            nothing: Value of pixels without a geom.

        Returns:
            Values (H, W), and depth along the optical axis (H, W), [m]; FAR_M for pixels without a geom.

        Raises:
            BackendError: The image is larger than the context.
        """
        colors, buffer = self._render(camera, qpos, ids=True)
        # Colors encode the number of each drawn geom.
        ids = colors.astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], np.int32)
        value_of_id = np.full(self._scene.ngeom + 1, nothing, geom_values.dtype)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                value_of_id[geom.segid + 1] = geom_values[geom.objid]
        return value_of_id[ids], depth_of(buffer)

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._context is not None:
            self._renderer.free()
            self._context.free()
            self._context = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _render(
        self, camera: Camera, qpos: ArrayLike, *, ids: bool
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Render colors (H, W, 3) and the depth buffer (H, W), upright."""
        width, height = camera.width, camera.height
        if not (width <= self._size[0] and height <= self._size[1]):
            problem = f"{width} x {height} exceeds the context's {self._size}"
            raise BackendError("offscreen rendering", problem, "ask for more")
        if self._context is None:
            raise ValueError("the renderer is closed")
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        mujoco.mjv_updateScene(
            self.model, self.data, self._option, None, mujoco.MjvCamera(),
            mujoco.mjtCatBit.mjCAT_ALL.value, self._scene,
        )  # fmt: skip
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            self._scene.flags[flag] = ids
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = not ids
        _place_camera(self._scene, camera)
        self._context.make_current()
        rect = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(rect, self._scene, self._renderer)
        colors, buffer = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.float32)
        mujoco.mjr_readPixels(colors, buffer, rect, self._renderer)
        return colors[::-1], buffer[::-1]


def depth_of(buffer: NDArray[np.float32]) -> NDArray[np.float64]:
    """Convert a depth buffer to depth along the optical axis, [m]; FAR_M for empty pixels."""
    return NEAR_M * FAR_M / (NEAR_M + buffer.astype(np.float64) * (FAR_M - NEAR_M))


def _place_camera(scene: mujoco.MjvScene, camera: Camera) -> None:
    """Set both of the scene's (stereo) cameras to the exact pinhole camera with its principal point."""
    left, right = -camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = camera.cy / camera.fy, -(camera.height - camera.cy) / camera.fy
    R_world_cam = camera.T_world_cam[:3, :3]
    for eye in scene.camera:
        eye.pos[:], eye.forward[:], eye.up[:] = camera.center, R_world_cam[:, 2], -R_world_cam[:, 1]
        eye.frustum_near, eye.frustum_far, eye.orthographic = NEAR_M, FAR_M, 0
        eye.frustum_center = NEAR_M * (left + right) / 2
        eye.frustum_width = NEAR_M * (right - left) / 2
        eye.frustum_top, eye.frustum_bottom = NEAR_M * top, NEAR_M * bottom


def offscreen_context(width: int, height: int) -> Any:
    """Create a context with MuJoCo's interface (`make_current`, `free`) for images up to width x height, [px].

    The environment variable `MUJOCO_GL` selects the driver (egl or osmesa); by default EGL is tried first.

    Raises:
        BackendError: No driver works.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    order = [wanted] if wanted in ("egl", "osmesa") else ["egl", "osmesa"]
    reasons = []
    for name in order:
        try:
            context = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
            context.make_current()
            return context
        except (ImportError, RuntimeError, AttributeError, OSError) as error:
            reasons.append(f"{name}: {error}")
    raise BackendError("offscreen rendering", f"no OpenGL driver works ({'; '.join(reasons)})", REMEDY)


# Default resolution of the robot's meshes, [m]. It displaces outlines by a few tenths of a millimeter and makes rendering
# several times faster.
CELL_M: Final = 0.001
# Resolution of the robot's meshes for masks, [m]. Masks are a few hundred pixels wide; finer meshes give the same masks.
MASK_CELL_M: Final = 0.003
# Robot masks (T, height, width) at log times (T,), width and height in px.
MasksAt = Callable[[Array, int, int], NDArray[np.bool_]]


class SilhouetteRenderer(ModelRenderer):
    """Renderer of one robot. It holds an OpenGL context until it is closed; not thread-safe."""

    def __init__(
        self, robot: RobotModel, *, max_width: int = 1920, max_height: int = 1440, cell_m: float = CELL_M
    ) -> None:
        """Create an OpenGL context for a robot.

        Args:
            robot: The robot to render.
            max_width, max_height: Largest image, [px].
            cell_m: Resolution of the robot's meshes; see `add_robot_visuals`.

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
        """Render the robot.

        Args:
            camera: Pinhole camera, world frame.
            joints: Arm joints (J,), [rad] or [m].
            gripper: Gripper value, from 0 (open) to 1 (closed).

        Returns:
            Body index (H, W) into `robot.body_names`, -1 where there is no robot; and depth along the optical axis (H, W), [m],
            0 where there is no robot.

        Raises:
            BackendError: The image is larger than the context.
        """
        qpos = self._robot.qpos(np.asarray(joints)[None], gripper)[0]
        bodies, depths = self.draw_values(camera, qpos, self.model.geom_bodyid - 1, nothing=-1)
        return bodies, np.where(bodies >= 0, depths, 0.0).astype(np.float32)


@contextmanager
def robot_masks(robot: RobotModel, camera: Camera, log: JointLog) -> Iterator[MasksAt]:
    """Yield a function that renders robot masks at log times in the demonstration camera, with one OpenGL context."""
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
    """Add simplified visual meshes to a model that contains the robot's bodies without their appearance.

    The run time of a software renderer depends mostly on the number of vertices.

    Args:
        spec: Model with the robot's bodies, to which the meshes are added.
        robot: Robot with the meshes.
        cell_m: Vertices in a cell of this size are merged; outlines are displaced by a fraction of it.
    """
    for number, (mesh, vertices, faces) in enumerate(_simplify_meshes(robot, cell_m)):
        name = f"looks_{number}"
        item = spec.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.ravel().astype(np.int32))
        item.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        material = spec.add_material(name=name, rgba=[*mesh.color_srgb, 1.0])
        material.specular, material.shininess = 0.4, 0.3
        add_visual_geom(spec.body(robot.body_names[mesh.body]), name)


def _simplify_meshes(robot: RobotModel, cell_m: float) -> list[tuple[RobotMesh, Array, NDArray[np.int64]]]:
    """Simplify every visual mesh; return it with the new vertices and faces.

    Meshes of one body use the same cells, so no cracks appear between them.
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
