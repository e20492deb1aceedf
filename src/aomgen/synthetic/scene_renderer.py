"""Pictures and part labels of a synthetic world, and what a real camera does to them."""

from types import TracebackType
from typing import Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import VISUAL_GROUP
from aomgen.conventions import BACKGROUND, MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera
from aomgen.core.values import Array
from aomgen.robots.offscreen import offscreen_context
from aomgen.robots.robot import RobotModel
from aomgen.robots.segmentation_ids import values_of_geoms
from aomgen.synthetic.layout import World

NEAR_M, FAR_M = 0.05, 20.0
# Spread of read-out noise, and of photon noise at full exposure, 0..255.
READ_NOISE, PHOTON_NOISE = 0.9, 1.6


class SceneRenderer:
    """Draws one compiled world; holds an OpenGL context until closed."""

    def __init__(self, robot: RobotModel, world: World, width: int, height: int) -> None:
        self._model = world.model
        self._model.vis.global_.offwidth, self._model.vis.global_.offheight = width, height
        self._data = mujoco.MjData(self._model)
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + 64)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[VISUAL_GROUP] = 1
        self._labels = _geom_labels(robot, world)
        self._context = offscreen_context(width, height)
        self._renderer = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._renderer)

    def draw(self, camera: Camera, qpos: Array) -> NDArray[np.uint8]:
        """Clean picture (H, W, 3) of a state qpos (nq,)."""
        return self._render(camera, qpos, ids=False)

    def labels(self, camera: Camera, qpos: Array) -> NDArray[np.uint8]:
        """Part labels (H, W): 0 background, 1 robot, 2 static, 3 moving; no anti-aliasing."""
        colors = self._render(camera, qpos, ids=True)
        return values_of_geoms(colors, self._scene, self._labels, nothing=0)

    def depths(self, camera: Camera, qpos: Array) -> NDArray[np.float64]:
        """Depth along the optical axis (H, W), [m]; FAR_M where nothing is."""
        self._place(camera, qpos, ids=True)
        rect = mujoco.MjrRect(0, 0, camera.width, camera.height)
        buffer = np.empty((camera.height, camera.width), np.float32)
        mujoco.mjr_readPixels(None, buffer, rect, self._renderer)
        return NEAR_M / (1.0 - buffer[::-1].astype(np.float64) * (1.0 - NEAR_M / FAR_M))

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._context is not None:
            self._renderer.free()
            self._context.free()
            self._context = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _render(self, camera: Camera, qpos: Array, *, ids: bool) -> NDArray[np.uint8]:
        self._place(camera, qpos, ids=ids)
        rect = mujoco.MjrRect(0, 0, camera.width, camera.height)
        picture = np.empty((camera.height, camera.width, 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, rect, self._renderer)
        return picture[::-1]

    def _place(self, camera: Camera, qpos: Array, *, ids: bool) -> None:
        """Draw a state into the buffers."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, mujoco.MjvCamera(),
            mujoco.mjtCatBit.mjCAT_ALL.value, self._scene,
        )  # fmt: skip
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            self._scene.flags[flag] = ids
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = not ids
        _place_camera(self._scene, camera)
        if self._context is None:
            raise ValueError("the painter is closed")
        self._context.make_current()
        rect = mujoco.MjrRect(0, 0, camera.width, camera.height)
        mujoco.mjr_render(rect, self._scene, self._renderer)


def expose(
    picture: NDArray[np.uint8], gain: float, noise: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The picture (H, W, 3) as a sensor records it: exposure gain, photon and read-out noise."""
    signal = picture.astype(np.float64) * gain
    spread = noise * np.sqrt(READ_NOISE**2 + PHOTON_NOISE**2 * signal / 255.0)
    noisy = signal + spread * rng.standard_normal(picture.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def _geom_labels(robot: RobotModel, world: World) -> NDArray[np.uint8]:
    model = world.model
    label_of_body = np.full(model.nbody, BACKGROUND, np.uint8)
    for name in robot.body_names:
        label_of_body[model.body(name).id] = ROBOT
    label_of_body[model.body(world.names.static_body).id] = STATIC
    label_of_body[model.body(world.names.moving_body).id] = MOVING
    return label_of_body[model.geom_bodyid]


def _place_camera(scene: mujoco.MjvScene, camera: Camera) -> None:
    """Give the scene's camera the exact pinhole, off-centre where the principal point is."""
    near_per_px = NEAR_M / camera.fx
    R_world_cam = camera.T_world_cam[:3, :3]
    for eye in scene.camera:
        eye.pos[:], eye.forward[:], eye.up[:] = camera.center, R_world_cam[:, 2], -R_world_cam[:, 1]
        eye.frustum_near, eye.frustum_far, eye.orthographic = NEAR_M, FAR_M, 0
        eye.frustum_center = near_per_px * (camera.width / 2 - camera.cx)
        eye.frustum_width = near_per_px * camera.width / 2
        eye.frustum_top = NEAR_M * camera.cy / camera.fy
        eye.frustum_bottom = NEAR_M * (camera.cy - camera.height) / camera.fy
