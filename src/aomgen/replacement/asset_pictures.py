"""Pictures of an asset's meshes in their own colors, without light: what its Gaussians are fitted to."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import VISUAL_GROUP, add_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.robots.model_renderer import ModelRenderer


class AssetRenderer(ModelRenderer):
    """Draws one asset with MuJoCo's rasterizer; holds an OpenGL context until closed. Not thread safe."""

    def __init__(self, asset: ArticulatedAsset, size: int) -> None:
        """Create a context for images of up to size x size, [px].

        Raises:
            BackendError: No OpenGL driver works.
        """
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        add_asset(spec, asset, np.eye(4), damping=0.0, frictionloss=0.0, visual=True)
        model = spec.compile()
        light = model.vis.headlight
        light.ambient[:], light.diffuse[:], light.specular[:] = 1.0, 0.0, 0.0
        super().__init__(model, (size, size), VISUAL_GROUP)
        # Thin walls are modelled by one sheet, seen from both sides.
        self._scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = False

    def draw(self, camera: Camera, theta: float) -> NDArray[np.float32]:
        """Colors and cover (H, W, 4), 0..1, one sample a pixel; zero where nothing is.

        Args:
            camera: Pose in the asset's frame.
            theta: Joint value.
        """
        colors, depth = self._render(camera, [theta], ids=False)
        covered = (depth > 0)[..., None]
        return np.concatenate([colors * covered / np.float32(255), covered], -1, dtype=np.float32)
