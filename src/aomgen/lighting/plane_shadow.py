"""Shadows on a level surface: the fast path of `visibility` for many directions of light and many frames.

The engine renders the bodies projected onto the surface along the light, so that an image is a map of the
shadow. For points above the surface, but below the bodies, the map is read at their projection along the
light (shadow mapping: Williams 1978, "Casting curved shadows on curved surfaces").
"""

from dataclasses import dataclass, replace
from typing import Annotated, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze_arrays
from aomgen.robots.robot import RobotModel
from aomgen.splatting.session import Motion, RenderSession, draw_outputs
from aomgen.twin.twin import OBJECT, TwinModel, standing_bodies

# Heights over which a visible point fades in and out of the surface, [m]. Depth of trained
# surfaces is uncertain, mostly downwards, because lower Gaussians are visible through upper ones.
HEIGHTS: Final = (-0.09, -0.06, 0.012, 0.03)
# Least side of the cells of a crisp shadow, [m], about a pixel, and of the shadow of a wide light, which is softer.
CELL, WIDE_CELL = 0.004, 0.012
# Largest number of cells along a side of a map.
MAP_SIDE: Final = 512
# Bodies carried by an arm do not cast a shadow farther from its base than this, [m].
REACH: Final = 2.5


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaneGrid:
    """Square cells on a level surface.

    Attributes:
        low: Corner of cell (0, 0), [m], in the frame of the surface, on which z = 0.
        cell: Side, [m].
        columns, rows: Number of cells along x and y.
    """

    low: Annotated[Array, "2"]
    cell: float
    columns: int
    rows: int

    __post_init__ = freeze_arrays

    def points(self) -> Array:
        """Compute the centers of the cells (rows, columns, 3), on the surface."""
        centers = self.low + (np.indices((self.columns, self.rows)).T + 0.5) * self.cell
        return np.concatenate([centers, np.zeros_like(centers[..., :1])], -1)

    def lookup(self, points: Array) -> csr_array:
        """Make a matrix (N, rows * columns) that interpolates a map at points (N, 2); 0 outside."""
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
    parts: NDArray[np.int32] | None,
    Ts_plane_part: Array,
    directions_plane: Array,
    grid: PlaneGrid,
    threads: int | None = None,
) -> NDArray[np.float32]:
    """Compute the share (T, D, rows, columns) of each direction's light that bodies block at each cell.

    Args:
        bodies: N Gaussians in the frames of their parts.
        parts: Part of each Gaussian (N,); None for one rigid body.
        Ts_plane_part: Poses (T, P, 4, 4) in the frame of the surface.
        directions_plane: Unit directions to the light (D, 3), z > 0.
        grid: Cells of the maps.
        threads: See `splatting.rasterizer.render`.
    """
    camera = Camera(
        fx=1 / grid.cell, fy=1 / grid.cell, cx=0.0, cy=0.0, width=grid.columns, height=grid.rows, T_world_cam=np.eye(4)
    )  # fmt: skip
    # The bodies are projected along the light onto the surface, which is at depth 1.
    Ts_flat = np.tile(np.eye(4), (len(directions_plane), 1, 1))
    Ts_flat[:, :2, 2] = -directions_plane[:, :2] / directions_plane[:, 2:]
    Ts_flat[:, :2, 3] = -grid.low
    Ts_flat[:, 2] = (0, 0, 0, 1)
    Ts = Ts_flat[None, :, None] @ np.asarray(Ts_plane_part)[:, None]
    shape = (*Ts.shape[:2], grid.rows, grid.columns)
    if not len(bodies):
        return np.zeros(shape, np.float32)
    session = RenderSession(bodies.select(np.zeros(0, np.int64)), camera, antialiased=True, threads=threads)
    parts = np.zeros(len(bodies), np.int32) if parts is None else parts
    motion = Motion(parts=parts, Ts_world_part=Ts.reshape(-1, *Ts.shape[2:]))
    (images,) = draw_outputs([session], bodies.with_sh_degree(0), motion, ("alpha",), threads=threads)
    return images["alpha"].reshape(shape)


def select_casters(
    twin: TwinModel, robot: RobotModel, new_object: bool = False
) -> tuple[TwinModel, TwinModel]:
    """Select the bodies whose shadow is new, and the static bodies whose shadow was scanned.

    The static part of a `new_object` was not scanned.
    """
    standing = standing_bodies(twin, robot)
    standing[twin.body(OBJECT)] &= not new_object
    stands, plain = standing[twin.bodies], replace(twin, relit=None)
    return plain.select(~stands), plain.select(stands & twin.moves)


def measure_blocked_light(
    casters: tuple[TwinModel, TwinModel],
    Ts_world_body: Array,
    T_world_plane: Array,
    directions: Array,
    points_world: Array,
    threads: int | None = None,
) -> Array:
    """Measure the share (T, N) of light from directions (K, 3) that is newly blocked at points (N, 3).

    Where other bodies cast a scanned shadow, no more light is removed. Cells depend on the points alone, so
    that equal states give equal results.

    Args:
        casters: Result of `select_casters`.
        Ts_world_body: Poses (T, B, 4, 4).
        T_world_plane: Pose of a surface near the points, on which the maps are computed.
        directions: Unit directions to the light, world frame.
        points_world: Points on, above or below the surface.
        threads: See `splatting.rasterizer.render`.
    """
    to_plane = invert(T_world_plane)
    directions_plane, points = directions @ to_plane[:3, :3].T, apply(to_plane, points_world)
    # Each point is projected onto the surface along the light.
    along = points[:, :2] - points[:, 2:] * (directions_plane[:, :2] / directions_plane[:, 2:])[:, None]
    reached = np.clip(along.reshape(-1, 2), to_plane[:2, 3] - REACH, to_plane[:2, 3] + REACH)
    if not len(reached):
        return np.zeros((len(Ts_world_body), 0))
    low, extent = reached.min(0), np.ptp(reached, axis=0)
    cell = max(float(extent.max()) / MAP_SIDE, CELL if len(directions) == 1 else WIDE_CELL)
    columns, rows = (np.ceil(extent / cell).astype(int) + 2).tolist()
    grid = PlaneGrid(low=low - cell, cell=cell, columns=columns, rows=rows)
    new, scanned = (
        project_shadow(twin.gaussians, twin.bodies, to_plane @ Ts, directions_plane, grid, threads)
        for twin, Ts in zip(casters, (Ts_world_body, Ts_world_body[:1]), strict=True)
    )
    maps = (new * (1 - scanned)).reshape(*new.shape[:2], -1)
    return np.mean([(grid.lookup(xy) @ maps[:, k].T).T for k, xy in enumerate(along)], 0)


def intersect_surface(T_world_plane: Array, camera: Camera, depth: Array) -> tuple[Array, Array]:
    """Intersect pixel rays with a plane (H, W, 3), and measure how much depths (H, W) belong to it, 0..1."""
    rays = camera.directions()
    to_plane = invert(T_world_plane)
    eye, falls = apply(to_plane, camera.center)[2], rays @ to_plane[2, :3]
    met = -eye / np.where(np.abs(falls) < 1e-9, 1e-9, falls)
    usable = (depth > 0) & (met > 0) & np.isfinite(met)
    belongs = surface_share(T_world_plane, camera.center + rays * depth[..., None]) * usable
    return camera.center + rays * np.where(usable, met, 0.0)[..., None], belongs


def surface_share(T_world_plane: Array, points_world: ArrayLike) -> Array:
    """Measure how much points (..., 3) belong to a surface, 0..1, by their height above it."""
    heights = apply(invert(T_world_plane), points_world)[..., 2]
    return np.interp(heights, HEIGHTS, (0.0, 1.0, 1.0, 0.0))
