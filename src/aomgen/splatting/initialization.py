"""Where training starts when only points are known."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from aomgen.core.gaussians import SH_C0, Gaussians, gaussians_of
from aomgen.core.values import Array


def gaussians_from_points(
    points: ArrayLike, colors_srgb: NDArray[np.uint8], *, opacity: float = 0.3, size: float = 0.7
) -> Gaussians:
    """One round Gaussian a point (N, 3), as wide as `size` times the distance to its neighbours, of SH degree 0.

    Raises:
        ValueError: Fewer than two points, coordinates that are not finite, or colors for other
            points.

    Source: Kerbl et al., "3D Gaussian splatting for real-time radiance field rendering", 2023,
    sec. 5.1.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or np.shape(colors_srgb) != points.shape:
        raise ValueError(f"points have shape {points.shape} and colors {np.shape(colors_srgb)}, want (N, 3)")
    scales = size * neighbour_distances(points)
    return gaussians_of(
        means=points,
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)),
        scales=np.repeat(scales[:, None], 3, axis=1),
        opacities=np.full(len(points), opacity),
        sh=((np.asarray(colors_srgb) / 255.0 - 0.5) / SH_C0)[:, None],
    )


def neighbour_distances(points: Array, neighbours: int = 3) -> Array:
    """Root mean square distance (N,) of points (N, 3) to their nearest neighbours.

    Points that coincide get a thousandth of the median, lonely ones at most the 99th percentile,
    so that no Gaussian starts without size and none covers the scene.
    """
    if not len(points) >= 2 or not np.isfinite(points).all():
        raise ValueError(f"{len(points)} points, want at least two with finite coordinates")
    count = min(neighbours, len(points) - 1)
    distances, _ = cKDTree(points).query(points, k=count + 1)
    spacing = np.sqrt((distances[:, 1:] ** 2).mean(1))
    apart = spacing[spacing > 0]
    if not len(apart):
        raise ValueError(f"{len(points)} points in one place, want at least two places")
    return np.clip(spacing, 1e-3 * np.median(apart), np.percentile(apart, 99))
