"""Render a compiled scene of robot and object: colors, part labels, depths."""

import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import VISUAL_GROUP
from aomgen.conventions import BACKGROUND, MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera
from aomgen.core.values import Array
from aomgen.robots.silhouette import ModelRenderer
from aomgen.simulation.scene import Scene


class SceneRenderer(ModelRenderer):
    """Renderer of one compiled scene: images, part labels and depths."""

    def __init__(self, scene: Scene, size: tuple[int, int]) -> None:
        """Create a context for images up to `size` (width, height), [px].

        Raises:
            BackendError: No OpenGL driver works.
        """
        super().__init__(scene.model, size, VISUAL_GROUP)
        model, names = scene.model, scene.names
        label_of_body = np.full(model.nbody, BACKGROUND, np.uint8)
        label_of_body[[model.body(name).id for name in scene.robot.body_names]] = ROBOT
        label_of_body[model.body(names.static_body).id] = STATIC
        label_of_body[model.body(names.moving_body).id] = MOVING
        self._geom_labels = label_of_body[model.geom_bodyid]

    def draw(self, camera: Camera, qpos: Array) -> NDArray[np.uint8]:
        """Render an image (H, W, 3) of a state qpos (nq,), with light and shadows."""
        return self._render(camera, qpos, ids=False)[0]

    def labels(self, camera: Camera, qpos: Array) -> NDArray[np.uint8]:
        """Render part labels (H, W) without anti-aliasing: 0 background, 1 robot, 2 static, 3 moving."""
        return self.draw_values(camera, qpos, self._geom_labels, nothing=BACKGROUND)[0]

    def depths(self, camera: Camera, qpos: Array) -> NDArray[np.float64]:
        """Render depths along the optical axis (H, W), [m]; the background has the depth FAR_M."""
        return self.draw_values(camera, qpos, self._geom_labels, nothing=BACKGROUND)[1]
