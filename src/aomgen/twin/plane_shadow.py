"""Shadows of bodies on a level surface for many directions of light and many frames at once.

Bodies are drawn as the light presses them flat onto the surface, so an image is a map of the shadow.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.light import Light
from aomgen.core.sh import sh_basis
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.splatting.session import Motion, RenderSession, draw_outputs
from aomgen.splatting.surfaces import sphere_directions
from aomgen.twin.twin import OBJECT, PART, TwinModel

# Cell of a map of soft light, [m]: it leaves no finer detail in a shadow.
CELL: Final = 0.015
# Soft shadow is followed this far from the object, and fades out over the last third, [m].
REACH: Final = 0.35
# Directions of soft light over the whole sphere, of which half lie above the plane; the map is smoothed after.
DIRECTIONS: Final = 160
# Joint values, from limit to limit, for which soft shadow is computed; between them it is interpolated.
STATES: Final = 9
# Light that things around throw into a shadow, as a share of what is blocked.
FILL: Final = 0.15
# Pixels drawn for each cell of a soft map, along a side.
FINER: Final = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaneGrid:
    """Square cells on a level surface.

    Attributes:
        low: Corner of cell (0, 0), [m], in the frame of the surface, on which z = 0.
        cell: Side, [m].
        columns, rows: Along x and y.
    """

    low: Annotated[Array, "2"]
    cell: float
    columns: int
    rows: int

    __post_init__ = freeze_arrays

    def points(self) -> Array:
        """Middles of the cells (rows, columns, 3), on the surface."""
        places = self.low + (np.indices((self.columns, self.rows)).T + 0.5) * self.cell
        return np.concatenate([places, np.zeros_like(places[..., :1])], -1)

    def window(self, rows: slice, columns: slice) -> "PlaneGrid":
        """Some of the rows and columns."""
        low = self.low + self.cell * np.array([columns.start, rows.start])
        return replace(self, low=low, columns=columns.stop - columns.start, rows=rows.stop - rows.start)

    def lookup(self, points: Array) -> csr_array:
        """Matrix (N, rows * columns) that interpolates a map at points (N, 2); 0 outside."""
        places = (points - self.low) / self.cell - 0.5
        corner = np.floor(places).astype(np.int64)
        share = places - corner
        entries = []
        for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
            column, row = corner[:, 0] + x, corner[:, 1] + y
            inside = (column >= 0) & (row >= 0) & (column < self.columns) & (row < self.rows)
            weight = np.abs(1 - x - share[:, 0]) * np.abs(1 - y - share[:, 1]) * inside
            entries.append((weight, np.where(inside, row * self.columns + column, 0)))
        weights, cells = (np.stack(part, 1).ravel() for part in zip(*entries, strict=True))
        starts = np.arange(0, 4 * len(points) + 1, 4)
        return csr_array((weights.astype(np.float32), cells, starts), (len(points), self.rows * self.columns))


def project_shadow(
    bodies: Gaussians,
    parts: NDArray[np.int32],
    Ts_plane_part: Array,
    directions_plane: Array,
    grid: PlaneGrid,
    threads: int | None = None,
) -> NDArray[np.float32]:
    """Share (T, rows, columns) of the light of a direction that bodies keep from each cell.

    Args:
        bodies: N Gaussians in the frames of their parts.
        parts: Part of each (N,).
        Ts_plane_part: Poses (T, P, 4, 4) in the frame of the surface.
        directions_plane: To the light (T, 3), z > 0.
        grid: Where on the surface.
        threads: As in `splatting.rasterizer.render`.
    """
    camera = Camera(
        fx=1 / grid.cell, fy=1 / grid.cell, cx=0.0, cy=0.0, width=grid.columns, height=grid.rows, T_world_cam=np.eye(4)
    )  # fmt: skip
    # Along the light onto the surface, which lies at depth 1.
    Ts_flat = np.tile(np.eye(4), (len(directions_plane), 1, 1))
    Ts_flat[:, :2, 2] = -directions_plane[:, :2] / directions_plane[:, 2:]
    Ts_flat[:, :2, 3] = -grid.low
    Ts_flat[:, 2] = (0, 0, 0, 1)
    session = RenderSession(bodies.select(np.zeros(0, np.int64)), camera, antialiased=True, threads=threads)
    motion = Motion(parts=parts, Ts_world_part=Ts_flat[:, None] @ Ts_plane_part)
    (images,) = draw_outputs([session], bodies.with_sh_degree(0), motion, ("alpha",), threads=threads)
    return images["alpha"]


def project_body_shadow(
    body: Gaussians,
    T_plane_body: Array,
    directions_plane: Array,
    grid: PlaneGrid,
    threads: int | None = None,
) -> NDArray[np.float32]:
    """Share (D, rows, columns) of the light of D directions that a body at one pose keeps from each cell."""
    index, poses = np.zeros(len(body), np.int32), np.tile(T_plane_body, (len(directions_plane), 1, 1, 1))
    return project_shadow(body, index, poses, directions_plane, grid, threads)


@dataclass(frozen=True, slots=True, kw_only=True)
class SoftShadow:
    """Light of many directions that an object lets through to the surface it stands on; moves along with it.

    Attributes:
        T_object_plane: Frame of the surface.
        grid: Cells of the maps.
        directions: To the light, unit, frame of the surface.
        thetas: Joint values of the maps.
        passed: Shares, 0..1.
    """

    T_object_plane: Matrix4
    grid: PlaneGrid
    directions: Annotated[Array, "D 3"]
    thetas: Annotated[Array, "K"]
    passed: Annotated[NDArray[np.float32], "D K _ _"]

    __post_init__ = freeze_arrays

    def arriving(self, light: Light, T_world_object: ArrayLike) -> NDArray[np.float32]:
        """Share (K, rows, columns) of a light's radiance that arrives where the object stands at a pose (4, 4)."""
        R = (np.asarray(T_world_object) @ self.T_object_plane)[:3, :3]
        radiance = (sh_basis(self.directions @ R.T, 2) @ light.radiance_sh).mean(1)
        weights = self.directions[:, 2] * np.maximum(radiance, 0)
        # einsum, not a product of matrices: a threaded BLAS may round differently from call to call.
        shares = np.einsum("d,dkij->kij", weights.astype(np.float32), self.passed) / max(weights.sum(), 1e-9)
        shares = np.stack([gaussian_filter(FILL + (1 - FILL) * share, 1.0) for share in shares])
        # The cell's distance from the border, as a share of the last third of the reach.
        from_side, from_end = (
            np.minimum(np.arange(n), n - 1 - np.arange(n)) for n in (self.grid.rows, self.grid.columns)
        )
        fade = np.clip(np.minimum(from_side[:, None], from_end) * CELL / (REACH / 3), 0, 1)
        return (1 - (1 - shares) * fade).astype(np.float32)

    def states(self, thetas: Array) -> csr_array:
        """Matrix (T, K) that interpolates between the maps at joint values (T,)."""
        place = np.interp(thetas, self.thetas, np.arange(len(self.thetas)))
        first = np.minimum(place.astype(np.int64), len(self.thetas) - 2)
        weights = np.stack([1 - (place - first), place - first], 1).ravel().astype(np.float32)
        columns, starts = np.stack([first, first + 1], 1).ravel(), np.arange(0, 2 * len(thetas) + 1, 2)
        return csr_array((weights, columns, starts), (len(thetas), len(self.thetas)))

    def scale_by(self, factor: float, prismatic: bool) -> "SoftShadow":
        """Of the object scaled about its origin."""
        T = np.array(self.T_object_plane)
        T[:3, 3] *= factor
        grid = replace(self.grid, low=self.grid.low * factor, cell=self.grid.cell * factor)
        thetas = self.thetas * factor if prismatic else self.thetas
        return replace(self, T_object_plane=T, grid=grid, thetas=thetas)


def compute_soft_shadow(
    twin: TwinModel, T_world_plane: ArrayLike, threads: int | None = None
) -> SoftShadow | None:
    """Soft shadow of a twin's lit object on a plane (4, 4) beneath it; None without such an object."""
    lit = (
        np.zeros(len(twin.bodies), bool)
        if twin.relit is None
        else np.isin(np.arange(len(twin.bodies)), twin.relit.indices)
    )
    still, part = (twin.gaussians.select(lit & (twin.bodies == twin.body(name))) for name in (OBJECT, PART))
    if not len(still):
        return None
    T_object_plane = invert(twin.T_world_object) @ np.asarray(T_world_plane, np.float64)
    T_plane_object = invert(T_object_plane)
    thetas: Array = np.linspace(
        twin.joint.lower, max(twin.joint.upper, twin.joint.lower + 1e-6), STATES, dtype=np.float64
    )
    Ts_part = T_plane_object @ twin.joint.motion(thetas)
    points = np.concatenate(
        [apply(T, body.means)[:, :2] for T, body in [(T_plane_object, still), *((T, part) for T in Ts_part)]]
    )
    low = points.min(0) - REACH
    columns, rows = np.ceil((points.max(0) + REACH - low) / CELL).astype(int).tolist()
    fine = PlaneGrid(low=low, cell=CELL / FINER, columns=FINER * columns, rows=FINER * rows)
    directions = sphere_directions(DIRECTIONS)
    directions = directions[directions[:, 2] > 0]

    def measure_passed(body: Gaussians, T_plane_body: Array) -> NDArray[np.float32]:
        cast = project_body_shadow(body, T_plane_body, directions, fine, threads)
        return 1 - cast.reshape(len(directions), rows, FINER, columns, FINER).mean((2, 4))

    around = measure_passed(still, T_plane_object)
    return SoftShadow(
        T_object_plane=T_object_plane,
        grid=PlaneGrid(low=low, cell=CELL, columns=columns, rows=rows),
        directions=directions,
        thetas=thetas,
        passed=np.stack([around * measure_passed(part, T) for T in Ts_part], 1),
    )
