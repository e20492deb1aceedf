"""Refine the rectangle of the moving part with its edges in scan images that show it from the front."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from scipy import ndimage

from aomgen.conventions import luma_from_srgb
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.parts.scan_views import ScanView
from aomgen.prompting.moved_panel import Front, Grip, Model, RegionAgreement, improve, place_corners
from aomgen.prompting.video_regions import REMEDY
from aomgen.prompting.view_choice import choose_front_views

# Number of views, which are those with the largest front.
VIEWS: Final = 8
# Sampled points along a side, without its ends, because corners are round.
SAMPLES: Final = np.linspace(0.04, 0.96, 40)
# Standard deviation of the blur before gradients, [px]; smallest luma gradient of a clear edge, [1/px].
BLUR_PX, CLEAR_EDGE = 1.2, 6 / 255
# Weight of edges relative to the region; it is below 1 because edges of other objects can be equally clear.
EDGE_WEIGHT: Final = 0.7
# Rectangles sampled around the first one, and standard deviations: sides and depth [m], yaw and slip [rad].
DRAWS, SPREAD = 6000, (0.04, 0.04, 0.03, 0.03, 0.02, 0.05, 0.05)
# Initial steps of the refinement, about half of the spread: sides and depth [m], yaw and slip [rad].
STEPS: Final = (0.02, 0.02, 0.02, 0.02, 0.01, 0.03, 0.03)


def measure_edges(views: Sequence[ScanView], grip: Grip) -> Callable[[Array], float]:
    """Return a function that computes the mean contrast, 0..1, of edges in scan images at the sides of a rectangle (7,).

    Signed gradients are averaged along a side, so that texture cancels out. The views have one size; gradients on the
    robot are zero.
    """
    size = np.array([views[0].camera.width, views[0].camera.height])
    Ps = np.stack([view.camera.K @ view.camera.T_cam_world[:3] for view in views])
    gradients = np.stack([_measure_gradients(view) for view in views])

    def measure(x: Array) -> float:
        corners = place_corners(grip, x)
        ends = np.roll(corners, -1, axis=0)
        points = (corners[:, None] + SAMPLES[:, None] * (ends - corners)[:, None]).reshape(-1, 3)
        cams = points @ np.swapaxes(Ps[:, :, :3], 1, 2) + Ps[:, None, :, 3]
        pixels = cams[..., :2] / np.maximum(cams[..., 2:], 1e-6)
        columns, rows = np.moveaxis(np.clip(pixels, 0, size - 1).astype(np.int64), -1, 0)
        at = np.arange(len(pixels))[:, None]
        slopes = gradients[at, rows, columns].reshape(len(pixels), 4, -1, 2)
        pixels = pixels.reshape(len(pixels), 4, -1, 2)
        along = pixels[:, :, -1] - pixels[:, :, 0]
        normals = np.stack([-along[..., 1], along[..., 0]], -1)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
        across = np.einsum("vsnk,vsk->vsn", slopes, normals)
        return float(np.abs(np.clip(across, -CLEAR_EDGE, CLEAR_EDGE).mean(-1)).mean() / CLEAR_EDGE)

    return measure


def _measure_gradients(view: ScanView) -> Array:
    """Compute luma gradients (H, W, 2) along x and y, 0 on the robot."""
    luma = ndimage.gaussian_filter(luma_from_srgb(view.image_srgb), BLUR_PX)
    along_y, along_x = np.gradient(luma)
    return np.where(view.robot[..., None], 0.0, np.stack([along_x, along_y], -1))


def refine_front(
    x: Array,
    model: Model,
    agreement: RegionAgreement,
    views: Sequence[ScanView],
    rng: np.random.Generator,
) -> Front:
    """Move the sides of a rectangle (7,) to edges in scan images, without leaving the region of the video.

    Raises:
        ReconstructionError: No view shows the part from the front.
    """
    grip = agreement.grip
    chosen = choose_front_views(views, Front(corners_world=place_corners(grip, x), confidence=0.0))[:VIEWS]
    if not chosen:
        raise ReconstructionError(
            "proposals",
            "no scan image shows the moving part from the front without the robot before it",
            REMEDY,
        )
    measure = measure_edges(chosen, grip)

    def score(candidate: Array) -> float:
        return agreement.score(candidate, model) + EDGE_WEIGHT * measure(candidate)

    draws = np.vstack([x, x + rng.normal(size=(DRAWS, len(x))) * SPREAD])
    _, best = improve(score, draws, STEPS)
    confidence = agreement.measure(best, model) * measure(best)
    return Front(corners_world=place_corners(grip, best), confidence=confidence)
