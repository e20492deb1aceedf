"""Shadows on a horizontal surface, computed faster than by `visibility`, for many directions of light and many frames.

The rasterizer renders the bodies projected onto the surface along the light, so that an image is a map of the shadow. For
points between the surface and the bodies, the map is evaluated at their projection along the light.

Source: Williams 1978, "Casting curved shadows on curved surfaces" (shadow mapping).
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

# Heights between which the share of a visible point that belongs to the surface rises from 0 to 1 and falls to 0, [m]. The
# depth of trained surfaces is mostly too large, because lower Gaussians are visible through upper ones.
HEIGHTS: Final = (-0.09, -0.06, 0.012, 0.03)
# Smallest cell size of the map of a sharp shadow, about a pixel, and of the softer shadow of a wide light, [m].
CELL, WIDE_CELL = 0.004, 0.012
# Largest number of cells along a side of a map.
MAP_SIDE: Final = 512
# Largest distance from the arm's base at which the shadows of moving bodies are computed, [m].
REACH: Final = 2.5


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaneGrid:
    """Grid of square cells on a horizontal surface.

    Attributes:
        low: Lower corner of cell (0, 0) (2,), [m], in the frame of the surface, on which z = 0.
        cell: Side of a cell, [m].
        columns, rows: Number of cells along x and y.
    """

    low: Annotated[Array, "2"]
    cell: float
    columns: int
    rows: int

    __post_init__ = freeze_arrays

    def points(self) -> Array:
        """Compute the centers of the cells (rows, columns, 3), in the frame of the surface, [m]."""
        centers = self.low + (np.indices((self.columns, self.rows)).T + 0.5) * self.cell
        return np.concatenate([centers, np.zeros_like(centers[..., :1])], -1)

    def lookup(self, points: Array) -> csr_array:
        """Make a sparse matrix (N, rows * columns) that interpolates a map at points (N, 2), [m]; maps are 0 outside the grid."""
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
    """Compute the share (T, D, rows, columns) of the light from each direction that bodies block at each cell.

    Args:
        bodies: N Gaussians in the frames of their parts.
        parts: Part of each Gaussian (N,); None for one rigid body.
        Ts_plane_part: Poses of the P parts in T frames (T, P, 4, 4), in the frame of the surface.
        directions_plane: Unit directions toward the light (D, 3) with z > 0, in the frame of the surface.
        grid: Cells of the maps.
        threads: See `splatting.rasterizer.render`.
    """
    camera = Camera(
        fx=1 / grid.cell, fy=1 / grid.cell, cx=0.0, cy=0.0, width=grid.columns, height=grid.rows, T_world_cam=np.eye(4)
    )  # fmt: skip
    # The bodies are projected along the light onto the surface, which is placed at depth 1 of the camera.
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
    """Select the bodies whose shadow must be computed, and the static bodies whose shadow is part of the scan.

    Args:
        twin, robot: Twin and its robot.
        new_object: The object was not part of the scan, so the shadow of its static part must be computed, too.
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
    """Compute the share (T, N) of light that is blocked at points in addition to the scanned shadows.

    Light is not removed twice where static bodies cast a scanned shadow. Cells depend only on the points, so that equal
    states give equal results.

    Args:
        casters: Result of `select_casters`.
        Ts_world_body: Body poses (T, B, 4, 4).
        T_world_plane: Pose of a surface near the points (4, 4), on which the maps are computed.
        directions: Unit directions toward the light (K, 3), world frame.
        points_world: Points (N, 3) on, above or below the surface.
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
    """Intersect the pixel rays of a camera with a plane.

    Args:
        T_world_plane: Pose of the plane (4, 4).
        camera: Camera, world frame.
        depth: Rendered depths (H, W), [m].

    Returns:
        Intersections (H, W, 3), world frame, and the share (H, W), 0..1, to which the points at the rendered depths belong
        to the plane.
    """
    rays = camera.directions()
    to_plane = invert(T_world_plane)
    eye, falls = apply(to_plane, camera.center)[2], rays @ to_plane[2, :3]
    met = -eye / np.where(np.abs(falls) < 1e-9, 1e-9, falls)
    usable = (depth > 0) & (met > 0) & np.isfinite(met)
    belongs = surface_share(T_world_plane, camera.center + rays * depth[..., None]) * usable
    return camera.center + rays * np.where(usable, met, 0.0)[..., None], belongs


def surface_share(T_world_plane: Array, points_world: ArrayLike) -> Array:
    """Compute the share, 0..1, to which points (..., 3) belong to a surface, from their heights above it."""
    heights = apply(invert(T_world_plane), points_world)[..., 2]
    return np.interp(heights, HEIGHTS, (0.0, 1.0, 1.0, 0.0))
