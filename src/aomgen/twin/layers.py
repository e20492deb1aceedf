"""Pictures of a twin from a fixed camera: what never moves is drawn once.

The moving Gaussians are drawn alone and laid over the static picture by depth. That differs
from drawing all together only where moving and static Gaussians interpenetrate.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.splatting.rasterizer import render

# A moving surface up to this far behind a static one is still in front: both touch there, [m].
TOUCH: Final = 0.015
# Depth over which it disappears behind, [m].
FADE: Final = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class StaticLayer:
    """What a camera sees without anything that moves.

    Attributes:
        camera: Which camera.
        rgb: (H, W, 3) float32, sRGB 0..1.
        depth: (H, W) float32, median depth, infinite where nothing is, [m].
    """

    camera: Camera
    rgb: NDArray[np.float32]
    depth: NDArray[np.float32]


def static_layer(gaussians: Gaussians, camera: Camera, threads: int | None = None) -> StaticLayer:
    """Draw what does not move (world frame)."""
    drawn = render(gaussians, camera, with_ids=True, threads=threads)
    median = drawn.median_depth
    depth = drawn.depth if median is None else np.where(median > 0, median, drawn.depth)
    return StaticLayer(
        camera=camera, rgb=drawn.rgb, depth=np.where(drawn.alpha > 0.1, depth, np.inf).astype(np.float32)
    )


def over(
    layer: StaticLayer,
    moving: Gaussians,
    shade: NDArray[np.float32] | None = None,
    threads: int | None = None,
) -> NDArray[np.uint8]:
    """Image (H, W, 3) uint8 of moving Gaussians (world frame) over a static layer.

    Args:
        layer: The rest of the scene.
        moving: What moves.
        shade: Factor on the static picture's sRGB values (H, W), for shadows.
        threads: As in `render`.
    """
    drawn = render(moving, layer.camera, threads=threads)
    behind = layer.rgb if shade is None else layer.rgb * shade[..., None]
    front = np.clip((layer.depth + np.float32(TOUCH) - drawn.depth) * np.float32(1 / FADE), 0, 1)[..., None]
    image = front * drawn.rgb + (1 - front * drawn.alpha[..., None]) * behind
    return (np.clip(image, 0, 1) * np.float32(255) + np.float32(0.5)).astype(np.uint8)
