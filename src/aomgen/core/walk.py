"""A walk with a camera around a scene: where each image was taken, and the sector from which none was."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.values import Array, freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Walk:
    """Cameras around what they look at.

    Attributes:
        target: Point nearest to all optical axes, in the frame of the cameras.
        axes: Unit vectors as rows: right and forward of the first camera, and up, the mean of all cameras.
        positions: Cameras from the target along these axes.
        directions: Optical axes, likewise.
    """

    target: Annotated[Array, "3"]
    axes: Annotated[Array, "3 3"]
    positions: Annotated[Array, "N 3"]
    directions: Annotated[Array, "N 3"]

    __post_init__ = freeze_arrays

    @property
    def azimuths(self) -> Array:
        """Directions (N,) of the cameras from the target, seen from above, [rad], from -pi to pi."""
        return np.arctan2(self.positions[:, 1], self.positions[:, 0])

    def find_gap(self) -> tuple[float, int, int]:
        """Find the widest sector without a camera.

        Returns:
            Its angle, [rad], and the cameras before and after it, counterclockwise from above.
        """
        order = np.argsort(self.azimuths, kind="stable")
        taken = self.azimuths[order]
        gaps = np.diff(np.append(taken, taken[0] + 2 * np.pi))
        widest = int(np.argmax(gaps))
        return float(gaps[widest]), int(order[widest]), int(order[(widest + 1) % len(order)])


def describe_walk(Ts_world_cam: Sequence[ArrayLike]) -> Walk:
    """Describe the cameras of a scan from above.

    Args:
        Ts_world_cam: Poses (4, 4) of at least two cameras, upright on average; any frame and scale.
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
    """Return the point (3,) nearest to all optical axes of poses (N, 4, 4), world frame."""
    Ts = np.asarray(Ts_world_cam, np.float64)
    axes, centers = Ts[:, :3, 2], Ts[:, :3, 3]
    projections = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # Axes that are nearly parallel determine a point at any distance; the smallest shift is taken.
    middle = centers.mean(0)
    return (
        middle
        + np.linalg.lstsq(
            projections.sum(0), np.einsum("nij,nj->i", projections, centers - middle), rcond=1e-6
        )[0]
    )


def _normalize(vector: NDArray[np.floating]) -> Array:
    return np.asarray(vector / np.linalg.norm(vector), np.float64)
