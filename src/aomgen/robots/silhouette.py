"""Exact pinhole images of the posed robot: which body covers each pixel, and how far away."""

from types import TracebackType
from typing import Final, Self

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.assets.mjcf import VISUAL_GROUP
from aomgen.core.camera import Camera
from aomgen.errors import BackendError
from aomgen.robots.offscreen import offscreen_context
from aomgen.robots.robot import RobotModel
from aomgen.robots.segmentation_ids import values_of_geoms
from aomgen.robots.visuals import add_robot_visuals

# Nothing of a robot is nearer to a camera, [m].
NEAR_M: Final = 0.02
# Nor farther, [m].
FAR_M: Final = 50.0
# Outlines move by some tenths of a millimetre, and drawing is several times faster.
CELL_M: Final = 0.001


class SilhouetteRenderer:
    """Draws one robot with MuJoCo's rasterizer; holds an OpenGL context until closed.

    Not safe to share between threads. Reads only what is drawn: no light, no anti-aliasing.
    """

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
        spec.visual.global_.offwidth = max_width
        spec.visual.global_.offheight = max_height
        self._robot = robot
        self._limits = (max_width, max_height)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + 8)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = True
        self._scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        self._option = mujoco.MjvOption()
        groups = self._model.geom_group
        shown = VISUAL_GROUP if np.any(groups == VISUAL_GROUP) else int(groups.min())
        self._option.geomgroup[:] = 0
        self._option.geomgroup[shown] = 1
        self._closed = False
        self._context = offscreen_context(max_width, max_height)
        self._renderer = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._renderer)
        self._renderer.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR

    def draw(
        self, camera: Camera, joints: ArrayLike, gripper: float
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Draw the robot in one state.

        Args:
            camera: Pinhole camera, world frame.
            joints: (J,), [rad].
            gripper: 0 open .. 1 closed.

        Returns:
            Body index (H, W) into `robot.body_names`, -1 where there is no robot; and depth along
            the optical axis (H, W) [m], 0 where there is no robot.

        Raises:
            BackendError: The image is larger than the context.
        """
        width, height = camera.width, camera.height
        if not (width <= self._limits[0] and height <= self._limits[1]):
            raise BackendError(
                "robot silhouette", f"{width} x {height} exceeds the context's {self._limits}", "ask for more"
            )
        self._data.qpos[:] = self._robot.qpos(np.asarray(joints)[None], gripper)[0]
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, mujoco.MjvCamera(),
            mujoco.mjtCatBit.mjCAT_ALL.value, self._scene,
        )  # fmt: skip
        _place_camera(self._scene, camera)
        self._context.make_current()
        rect = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(rect, self._scene, self._renderer)
        colors = np.empty((height, width, 3), np.uint8)
        buffer = np.empty((height, width), np.float32)
        mujoco.mjr_readPixels(colors, buffer, rect, self._renderer)
        bodies = values_of_geoms(colors[::-1], self._scene, self._model.geom_bodyid - 1, nothing=-1)
        depth = NEAR_M * FAR_M / (NEAR_M + buffer[::-1].astype(np.float64) * (FAR_M - NEAR_M))
        return bodies, np.where(bodies >= 0, depth, 0.0).astype(np.float32)

    def close(self) -> None:
        """Free the OpenGL context."""
        if not self._closed:
            self._renderer.free()
            self._context.free()
            self._closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _place_camera(scene: mujoco.MjvScene, camera: Camera) -> None:
    """Set both of the scene's (stereo) cameras to an off-centre frustum."""
    left, right = -camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = camera.cy / camera.fy, -(camera.height - camera.cy) / camera.fy
    R_world_cam = camera.T_world_cam[:3, :3]
    for eye in scene.camera:
        eye.pos[:] = camera.center
        eye.forward[:] = R_world_cam[:, 2]
        eye.up[:] = -R_world_cam[:, 1]
        eye.frustum_near, eye.frustum_far = NEAR_M, FAR_M
        eye.frustum_center = NEAR_M * (left + right) / 2
        eye.frustum_width = NEAR_M * (right - left) / 2
        eye.frustum_top, eye.frustum_bottom = NEAR_M * top, NEAR_M * bottom
        eye.orthographic = 0
