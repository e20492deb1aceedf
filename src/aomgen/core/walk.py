"""Positions of the cameras of a scan around the scene, and the widest sector without a camera."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.values import Array, freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Walk:
    """N cameras of a scan relative to the point at which they are directed.

    Attributes:
        target: Point closest to all optical axes (3,), in the frame of the cameras.
        axes: Unit vectors as rows (3, 3): right and forward directions of the first camera, and the mean up direction.
        positions: Camera positions (N, 3) relative to the target, along these axes.
        directions: Directions of the optical axes (N, 3), along these axes.
    """

    target: Annotated[Array, "3"]
    axes: Annotated[Array, "3 3"]
    positions: Annotated[Array, "N 3"]
    directions: Annotated[Array, "N 3"]

    __post_init__ = freeze_arrays

    @property
    def azimuths(self) -> Array:
        """Azimuths (N,) of the cameras as seen from the target, [rad], in -pi..pi."""
        return np.arctan2(self.positions[:, 1], self.positions[:, 0])

    def find_gap(self) -> tuple[float, int, int]:
        """Find the widest sector without a camera.

        Returns:
            Its angle, [rad], and the indices of the cameras before and after it, counterclockwise as seen from above.
        """
        order = np.argsort(self.azimuths, kind="stable")
        taken = self.azimuths[order]
        gaps = np.diff(np.append(taken, taken[0] + 2 * np.pi))
        widest = int(np.argmax(gaps))
        return float(gaps[widest]), int(order[widest]), int(order[(widest + 1) % len(order)])


def describe_walk(Ts_world_cam: Sequence[ArrayLike]) -> Walk:
    """Compute the positions of the cameras of a scan relative to their common target.

    Args:
        Ts_world_cam: Poses (4, 4) of at least two cameras, which are upright on average, in any frame and scale.
    """
    Ts = np.asarray(Ts_world_cam, np.float64)
    up = _normalize(-Ts[:, :3, 1].mean(0))
    target = find_target(Ts)
    right = _normalize(np.cross(Ts[0, :3, 2], up))
    axes = np.array([right, np.cross(up, right), up], np.float64)
    return Walk(
        target=target,
        axes=axes,
        positions=(Ts[:, :3, 3] - target) @ axes.T,
        directions=Ts[:, :3, 2] @ axes.T,
    )


def find_target(Ts_world_cam: ArrayLike) -> Array:
    """Compute the point (3,), world frame, that is closest to the optical axes of poses (N, 4, 4), by least squares."""
    Ts = np.asarray(Ts_world_cam, np.float64)
    axes, centers = Ts[:, :3, 2], Ts[:, :3, 3]
    projections = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # Nearly parallel axes do not determine the distance of the point; the solution closest to the mean position is used.
    middle = centers.mean(0)
    return (
        middle
        + np.linalg.lstsq(
            projections.sum(0), np.einsum("nij,nj->i", projections, centers - middle), rcond=1e-6
        )[0]
    )


def _normalize(vector: NDArray[np.floating]) -> Array:
    return np.asarray(vector / np.linalg.norm(vector), np.float64)
