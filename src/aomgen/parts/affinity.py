"""Affinity features: what belongs together, at a chosen size. [paper 4.1]

Every Gaussian carries a D-dimensional feature; a gate that depends on the size asked for switches its
channels on and off, and two Gaussians belong together at that size when their gated features point the
same way. Source: SAGA (Cen et al., Segment Any 3D Gaussians, AAAI 2025), sec. 3; own code.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array, freeze
from aomgen.errors import BackendError
from aomgen.splatting.rasterizer import render

# Below this alpha a pixel shows nothing.
SOLID_ALPHA = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class SizedMasks:
    """Masks of one view and how large each of them is in the scene.

    Attributes:
        camera: The view, at the resolution of the masks, world frame.
        masks: (M, H, W), without pixels that show nothing.
        sizes_m: (M,), see `mask_size`, [m].
    """

    camera: Camera
    masks: NDArray[np.bool_]
    sizes_m: Array

    def __post_init__(self) -> None:
        shape = (len(self.masks), self.camera.height, self.camera.width)
        freeze(self, "masks", self.masks, shape, np.bool_)
        freeze(self, "sizes_m", self.sizes_m, (len(self.masks),))


@dataclass(frozen=True, slots=True, kw_only=True)
class Affinity:
    """Trained features of N Gaussians.

    Attributes:
        features: (N, D) float32.
        gate_slopes: (D,), of the gates over the relative size.
        gate_offsets: (D,).
        sizes_m: (K,), sizes of the masks it was trained with, ascending, [m]. The relative size is
            the rank among them, 0..1, so that gates do not depend on the scene's extent.
    """

    features: NDArray[np.float32]
    gate_slopes: Array
    gate_offsets: Array
    sizes_m: Array

    def __post_init__(self) -> None:
        freeze(self, "features", self.features, (None, None), np.float32)
        freeze(self, "gate_slopes", self.gate_slopes, (self.features.shape[1],))
        freeze(self, "gate_offsets", self.gate_offsets, (self.features.shape[1],))
        freeze(self, "sizes_m", self.sizes_m, (None,))

    def gate(self, size_m: float) -> NDArray[np.float32]:
        """Factors (D,) in 0..1 of the channels at a size."""
        rank = relative_sizes(np.array([size_m]), self.sizes_m)[0]
        return (1 / (1 + np.exp(-(self.gate_slopes * rank + self.gate_offsets)))).astype(np.float32)

    def at_size(self, size_m: float) -> NDArray[np.float32]:
        """Gated features (N, D) of unit length; zero where a Gaussian has none."""
        return unit(self.features * self.gate(size_m))


def relative_sizes(sizes_m: Array, known_m: Array) -> Array:
    """Ranks 0..1 of sizes among ascending known ones, on a logarithmic scale between neighbors."""
    distinct = np.unique(known_m)
    if len(distinct) < 2:
        return np.full(len(sizes_m), 0.5)
    return np.interp(np.log(sizes_m), np.log(distinct), np.linspace(0, 1, len(distinct)))


def unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Rows of length 1; rows of length 0 stay."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return (vectors / np.maximum(lengths, 1e-9)).astype(np.float32)


def measure_masks(gaussians: Gaussians, camera: Camera, masks: NDArray[np.bool_], width: int) -> SizedMasks:
    """Masks at a smaller resolution with their sizes from the rendered depth.

    Args:
        gaussians: The scene, world frame.
        camera: The view at full resolution.
        masks: (M, H, W) at full resolution.
        width: Width of the result, [px]; a smaller image stays as it is.

    Returns:
        The masks that still show something.
    """
    factor = min(1.0, width / camera.width)
    small = camera.resized(round(camera.width * factor), max(1, round(camera.height * factor)))
    rows = ((np.arange(small.height) + 0.5) * camera.height / small.height).astype(int)
    columns = ((np.arange(small.width) + 0.5) * camera.width / small.width).astype(int)
    depth = surface_depth(gaussians, small)
    cut = masks[:, rows][:, :, columns] & (depth > 0)
    points = small.center + small.directions() * depth[..., None]
    kept = [index for index, mask in enumerate(cut) if mask.sum() >= 4]
    sizes = np.array([mask_size(points[cut[index]]) for index in kept])
    return SizedMasks(camera=small, masks=cut[kept], sizes_m=sizes)


def surface_depth(gaussians: Gaussians, camera: Camera) -> NDArray[np.float32]:
    """Depth (H, W) of the surface, [m]; 0 where a pixel shows nothing.

    Half of what a pixel shows lies before it. The mean depth is no surface where a few Gaussians
    shine through glass or past an edge from far behind.

    Raises:
        BackendError: The engine is missing.
    """
    drawn = render(gaussians, camera, with_ids=True)
    if drawn.median_depth is None:
        raise BackendError("rasterizer", "drew no depth", "rebuild the engine")
    return np.where((drawn.alpha > SOLID_ALPHA) & (drawn.median_depth > 0), drawn.median_depth, 0)


def mask_size(points_world: Array) -> float:
    """Twice the spread of the points (N, 3) that a mask shows, [m].

    The spread of the middle nine tenths along each axis, so that a rim of background pixels, which
    lie far behind, does not count.
    """
    low, high = np.quantile(points_world, [0.05, 0.95], axis=0)
    inside = np.all((points_world >= low) & (points_world <= high), axis=1)
    kept = points_world[inside] if inside.sum() >= 4 else points_world
    return float(max(2 * np.linalg.norm(kept.std(axis=0)), 1e-6))
