"""The robot's masks over the demonstration, drawn from its joint log."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.joint_log import JointLog
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.robots.silhouette import SilhouetteRenderer

# Robot masks (T, height, width) at log times (T,), width and height in px.
MasksAt = Callable[[Array, int, int], NDArray[np.bool_]]

# Masks are compared at a few hundred pixels, where finer meshes would not be seen, [m].
CELL_M = 0.003


@contextmanager
def robot_masks(robot: RobotModel, camera: Camera, log: JointLog) -> Iterator[MasksAt]:
    """A function that draws robot masks at log times in the demonstration camera; one OpenGL context."""
    with SilhouetteRenderer(
        robot, max_width=camera.width, max_height=camera.height, cell_m=CELL_M
    ) as renderer:

        def masks_at(times_s: Array, width: int, height: int) -> NDArray[np.bool_]:
            small = camera.resized(width, height)
            joints, gripper = log.at(times_s)
            masks = np.empty((len(times_s), height, width), bool)
            for k, (row, closing) in enumerate(zip(joints, gripper, strict=True)):
                masks[k] = renderer.draw(small, row, float(closing))[0] >= 0
            return masks

        yield masks_at
