"""Images of an asset's meshes in their own colors, without light; the Gaussians of the asset are fitted to them."""

from dataclasses import replace
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import VISUAL_GROUP, add_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.mesh import Mesh
from aomgen.robots.silhouette import ModelRenderer, depth_of

# Cosine between the normals of two corners of a pixel that lie on one face.
FLAT: Final = 0.99
# Samples along each side of a pixel, because a camera averages over the pixel.
SAMPLES: Final = 2
# Radius of the white sphere, [m], and its geometry group: rendering in front of it measures transparency.
BACKDROP_M, BACKDROP_GROUP = 15.0, 4


class AssetRenderer(ModelRenderer):
    """Renderer of one asset by MuJoCo's rasterizer; holds an OpenGL context until it is closed. Not thread safe."""

    def __init__(self, asset: ArticulatedAsset, size: int) -> None:
        """Create a context for images of up to size x size, [px].

        Raises:
            BackendError: No OpenGL driver works.
        """
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        static, moving = (
            replace(link, meshes=tuple(map(_drawn_twice, link.meshes)))
            for link in (asset.static, asset.moving)
        )
        drawn = replace(asset, static=static, moving=moving)
        add_asset(spec, drawn, np.eye(4), damping=0.0, frictionloss=0.0, visual=True)
        self._see_through = any(mesh.see_through for mesh in (*static.meshes, *moving.meshes))
        if self._see_through:
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[BACKDROP_M, 0, 0], rgba=[1, 1, 1, 1],
                group=BACKDROP_GROUP, contype=0, conaffinity=0,
            )  # fmt: skip
        model = spec.compile()
        light = model.vis.headlight
        light.ambient[:], light.diffuse[:], light.specular[:] = 1.0, 0.0, 0.0
        super().__init__(model, (SAMPLES * size, SAMPLES * size), VISUAL_GROUP)
        # Thin walls are modelled by one sheet, seen from both sides.
        self._scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = False

    def draw(self, camera: Camera, theta: float) -> NDArray[np.float32]:
        """Render colors and coverage (H, W, 4), 0..1, each pixel the mean of `SAMPLES` squared samples; zero outside the asset.

        Args:
            camera: Pose in the asset's frame.
            theta: Joint value.
        """
        fine = camera.resize(SAMPLES * camera.width, SAMPLES * camera.height)
        colors, buffer = self._render(fine, [theta], ids=False)
        solid = (buffer > 0)[..., None]
        if not self._see_through:
            return _pool(np.concatenate([colors * solid, solid * np.uint8(255)], -1))
        self._option.geomgroup[BACKDROP_GROUP] = 1
        before_white, _ = self._render(fine, [theta], ids=False)
        self._option.geomgroup[BACKDROP_GROUP] = 0
        rgb = _pool(colors)
        shone = (_pool(before_white) - rgb).mean(-1, keepdims=True)
        return np.concatenate([rgb, np.clip(1 - shone, 0, 1)], -1)

    def draw_normals(self, camera: Camera, theta: float) -> NDArray[np.float32]:
        """Render unit normals (H, W, 3) towards the camera, asset frame; zero outside the asset, at its edges and where it is
        transparent.
        """
        _, buffer = self._render(camera, [theta], ids=False)
        points = (camera.directions() * depth_of(buffer)[..., None]).astype(np.float32)
        normals = _normals(points) * (buffer > 0)[..., None]
        if not self._see_through:
            return normals
        blending = self.model.mat_rgba[self.model.geom_matid, 3] < 1
        return normals * ~self.draw_values(camera, [theta], blending, nothing=False)[0][..., None]


def _pool(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Average the squares of `SAMPLES` x `SAMPLES` pixels of an image (H, W, C) of 0..255; the means are 0..1."""
    sums = np.zeros((image.shape[0] // SAMPLES, image.shape[1] // SAMPLES, image.shape[2]), np.float32)
    for row in range(SAMPLES):
        for column in range(SAMPLES):
            sums += image[row::SAMPLES, column::SAMPLES]
    return sums / np.float32(255 * SAMPLES**2)


def _drawn_twice(mesh: Mesh) -> Mesh:
    """Reduce a mesh's opacity so that two layers are as opaque as it, because MuJoCo blends transparent meshes twice."""
    if not mesh.see_through:
        return mesh
    maps = dict(mesh.maps)
    if "opacity" in maps:
        maps["opacity"] = np.round(255 * (1 - np.sqrt(1 - maps["opacity"] / 255))).astype(np.uint8)
    return replace(mesh, opacity=1 - np.sqrt(1 - mesh.opacity), maps=maps)


def _normals(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute unit normals (H, W, 3), towards the camera at the origin, of points (H, W, 3); zero where two corners differ."""
    right, down = np.diff(points, axis=1), np.diff(points, axis=0)
    found = []
    for corner in (0, 1):
        inner = slice(1, None) if corner else slice(None, -1)
        normal = np.zeros_like(points)
        normal[inner, inner] = np.cross(down[:, inner], right[inner])
        found.append(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12))
    first, second = found
    away = (points * first).sum(-1, keepdims=True) > 0
    flat = (first * second).sum(-1, keepdims=True) > FLAT
    return np.where(away, -first, first) * flat
