"""Pictures of an asset's meshes in their own colors, without light: what its Gaussians are fitted to."""

from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import VISUAL_GROUP, add_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.values import Array
from aomgen.robots.model_renderer import ModelRenderer, depth_of

# Cosine between the normals of two corners of a pixel that lie on one face; length of a mean normal of such pixels.
FLAT: Final = 0.99


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
        return self.draw_surface(camera, theta)[0]

    def draw_surface(self, camera: Camera, theta: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The same, and unit normals (H, W, 3) towards the camera, asset frame; zero at edges and where nothing is."""
        colors, buffer = self._render(camera, [theta], ids=False)
        covered = (buffer > 0)[..., None]
        rgba = np.concatenate([colors * covered / np.float32(255), covered], -1, dtype=np.float32)
        points = camera.center + camera.directions() * depth_of(buffer)[..., None]
        return rgba, _normals(points, camera) * covered


def _normals(points: Array, camera: Camera) -> NDArray[np.float32]:
    """Unit normals (H, W, 3) of points (H, W, 3) towards the camera; zero where those of two corners differ."""
    right, down = np.diff(points, axis=1), np.diff(points, axis=0)
    found = []
    for corner in (0, 1):
        inner = slice(1, None) if corner else slice(None, -1)
        normal = np.zeros_like(points)
        normal[inner, inner] = np.cross(down[:, inner], right[inner])
        found.append(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12))
    first, second = found
    away = ((points - camera.center) * first).sum(-1, keepdims=True) > 0
    flat = (first * second).sum(-1, keepdims=True) > FLAT
    return (np.where(away, -first, first) * flat).astype(np.float32)
