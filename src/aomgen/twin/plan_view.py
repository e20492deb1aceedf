"""Orthographic top views of the plane on which an object stands."""

from dataclasses import dataclass
from typing import Annotated, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import apply, transform
from aomgen.core.values import Array, freeze_arrays
from aomgen.splatting.rasterizer import render
from aomgen.twin.support import Support, on_surface

Value = TypeVar("Value", bound=np.generic)
# Distance of a camera from the plane at which its image is practically orthographic, [m].
FAR: Final = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanView:
    """Grid of cells (H, W) on a plane; the center of cell (i, j) is `low + (j + 0.5, i + 0.5) * cell`.

    Attributes:
        support: The plane.
        low, high: Lower and upper corner of the grid's rectangle (2,), plane frame, [m].
        cell: Side of a cell, [m].
    """

    support: Support
    low: Annotated[Array, "2"]
    high: Annotated[Array, "2"]
    cell: float

    __post_init__ = freeze_arrays

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns."""
        columns, rows = (int(n) for n in np.ceil((self.high - self.low) / self.cell))
        return rows, columns

    @property
    def xy(self) -> Array:
        """Centers of the cells (H, W, 2), plane frame, [m]."""
        rows, columns = np.indices(self.shape)
        return self.low + (np.stack([columns, rows], -1) + 0.5) * self.cell

    @property
    def camera(self) -> Camera:
        """Camera far above the plane; its x axis is that of the plane, and its y axis is opposite to that of the plane."""
        rows, columns = self.shape
        R = self.support.T_world_plane[:3, :3] * [1.0, -1.0, -1.0]
        middle = np.append(self.low + np.array([columns, rows]) * self.cell / 2, 0.0)
        center = apply(self.support.T_world_plane, middle)
        return Camera(
            fx=FAR / self.cell, fy=FAR / self.cell, cx=columns / 2, cy=rows / 2, width=columns, height=rows,
            T_world_cam=transform(R, center - FAR * R[:, 2]),
        )  # fmt: skip

    def cover(self, gaussians: Gaussians) -> Array:
        """Compute the coverage of each cell (H, W), 0..1, by Gaussians on the plane."""
        return self.mean(gaussians, np.zeros((len(gaussians), 1), np.float32))[1]

    def mean(self, gaussians: Gaussians, values: NDArray[np.float32]) -> tuple[Array, Array]:
        """Compute the means (H, W, K) of values (N, K) of the Gaussians on the plane, and their coverage (H, W), 0..1."""
        flat = on_surface(gaussians, self.support)
        drawn = render(gaussians.select(flat).with_sh_degree(0), self.camera, features=values[flat])
        cover, sums = (np.asarray(image, np.float64)[::-1] for image in (drawn.alpha, drawn.features))
        return sums / np.maximum(cover, 1e-6)[..., None], cover

    def lookup(self, image: NDArray[Value], gaussians: Gaussians, otherwise: float) -> NDArray[Value]:
        """Look up the values (N, ...) of an image (H, W, ...) at the positions of Gaussians.

        Args:
            image: Values of the cells (H, W, ...).
            gaussians: N Gaussians, world frame.
            otherwise: Value for Gaussians outside of the grid.
        """
        cells = np.floor((self.support.coordinates(gaussians.means)[:, :2] - self.low) / self.cell)
        column, row = cells.astype(np.int64).T
        rows, columns = self.shape
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        values = np.full((len(gaussians), *image.shape[2:]), otherwise, image.dtype)
        values[inside] = image[row[inside], column[inside]]
        return values
