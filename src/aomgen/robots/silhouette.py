"""Exact pinhole images of the posed robot: which body covers each pixel, and how far away."""

from types import TracebackType
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.assets.mjcf import VISUAL_GROUP
from aomgen.core.camera import Camera
from aomgen.robots.model_renderer import ModelRenderer
from aomgen.robots.robot import RobotModel
from aomgen.robots.visuals import add_robot_visuals

# Outlines move by some tenths of a millimetre, and drawing is several times faster.
CELL_M: Final = 0.001


class SilhouetteRenderer:
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
        self._robot = robot
        self._renderer = ModelRenderer(model, (max_width, max_height), shown)

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
        qpos = self._robot.qpos(np.asarray(joints)[None], gripper)[0]
        body_of_geom = self._renderer.model.geom_bodyid - 1
        bodies, depths = self._renderer.draw_values(camera, qpos, body_of_geom, nothing=-1)
        return bodies, np.where(bodies >= 0, depths, 0.0).astype(np.float32)

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
