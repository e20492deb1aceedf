"""Coverage of a scan: how many views see each place, and from how different directions.

A place is anything with a position: a Gaussian, a point on the side of a box. A view sees it when
it lies inside the image, faces the camera, and the surface drawn there is not in front of it.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array, freeze_arrays
from aomgen.splatting.surfaces import PARALLAX_DEG, ViewDepth

# Views that a depth needs: one, and two that confirm it.
MIN_VIEWS = 3
# A side under a flatter angle than this shows nothing.
MIN_COSINE = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """Coverage of N places.

    Attributes:
        views: Number of views that see each, (N,).
        spread_deg: Width of the cone around the mean direction that holds all directions from which each is
            seen, (N,), [deg]; 0 with less than two views.
    """

    views: Annotated[NDArray[np.uint16], "N"]
    spread_deg: Annotated[NDArray[np.float32], "N"]

    __post_init__ = freeze_arrays

    @property
    def enough(self) -> NDArray[np.bool_]:
        """Places (N,) whose depth the scan decides."""
        return (self.views >= MIN_VIEWS) & (self.spread_deg >= PARALLAX_DEG)


def coverage_of(points: Array, views: list[ViewDepth], normals: Array | None = None) -> Coverage:
    """Compute the coverage of points (N, 3).

    Args:
        points: In the frame of the views' cameras.
        views: What each view sees.
        normals: Unit outward directions (N, 3); without them every side counts.
    """
    seen = np.zeros((len(views), len(points)), bool)
    directions = np.zeros((len(views), len(points), 3), np.float32)
    for row, view in enumerate(views):
        rays = view.camera.center - points
        directions[row] = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        # NaN, where the view does not look, compares as False.
        seen[row] = view.behind(points) <= 1
        if normals is not None:
            seen[row] &= (directions[row] * normals).sum(1) > MIN_COSINE
    middle = np.einsum("vn,vnk->nk", seen.astype(np.float32), directions)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    cosines = np.where(seen, np.einsum("vnk,nk->vn", directions, middle), 1.0).min(0, initial=1.0)
    return Coverage(views=seen.sum(0), spread_deg=2 * np.degrees(np.arccos(np.clip(cosines, -1, 1))))
