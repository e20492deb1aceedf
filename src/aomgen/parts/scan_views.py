"""Between Gaussians and the masks of scan images: what a mask shows, and masks that labels draw."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, STATIC
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.errors import BackendError
from aomgen.segmentation.interface import Mask
from aomgen.splatting.rasterizer import contribution_weights, render


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanView:
    """A scan image in the world frame, with the pixels where the aligned robot is drawn."""

    name: str
    camera: Camera
    image_srgb: NDArray[np.uint8]
    robot: Mask


def spread(views: Sequence[ScanView], count: int) -> list[ScanView]:
    """About so many of the views, evenly in their order."""
    return list(views[:: max(1, len(views) // count)])


def lift(gaussians: Gaussians, view: ScanView, masks: list[Mask]) -> NDArray[np.float32]:
    """Blended weight (N, M) of every Gaussian in each mask of one view."""
    return contribution_weights(gaussians, view.camera, np.stack(masks).astype(np.float32))


def render_parts(gaussians: Gaussians, labels: NDArray[np.uint8], camera: Camera) -> dict[int, Mask]:
    """Masks of static and moving part as their Gaussians paint them, occlusion included."""
    features = np.stack([labels == STATIC, labels == MOVING], 1).astype(np.float32)
    shares = render(gaussians, camera, features=features).features
    if shares is None:
        raise BackendError("rasterizer", "drew no features", "rebuild the engine")
    return {STATIC: shares[..., 0] > 0.5, MOVING: shares[..., 1] > 0.5}
