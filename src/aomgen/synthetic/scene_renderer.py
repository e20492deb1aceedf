"""Pictures and part labels of a synthetic scene, and what a real camera does to them."""

import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import VISUAL_GROUP
from aomgen.conventions import BACKGROUND, MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera
from aomgen.core.values import Array
from aomgen.robots.model_renderer import ModelRenderer
from aomgen.simulation.scene import Scene

# Spread of read-out noise, and of photon noise at full exposure, 0..255.
READ_NOISE, PHOTON_NOISE = 0.9, 1.6


class SceneRenderer(ModelRenderer):
    """Draws one compiled scene and its part labels."""

    def __init__(self, scene: Scene, size: tuple[int, int]) -> None:
        """Width and height of the largest picture, [px].

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

    def labels(self, camera: Camera, qpos: Array) -> NDArray[np.uint8]:
        """Part labels (H, W): 0 background, 1 robot, 2 static, 3 moving; no anti-aliasing."""
        return self.draw_values(camera, qpos, self._geom_labels, nothing=BACKGROUND)[0]

    def depths(self, camera: Camera, qpos: Array) -> NDArray[np.float64]:
        """Depth along the optical axis (H, W), [m]; FAR_M where nothing is."""
        return self.draw_values(camera, qpos, self._geom_labels, nothing=BACKGROUND)[1]


def expose(
    picture: NDArray[np.uint8], gain: float, noise: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The picture (H, W, 3) as a sensor records it: exposure gain, photon and read-out noise."""
    signal = picture.astype(np.float64) * gain
    spread = noise * np.sqrt(READ_NOISE**2 + PHOTON_NOISE**2 * signal / 255.0)
    noisy = signal + spread * rng.standard_normal(picture.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)
