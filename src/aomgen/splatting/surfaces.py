"""Visibility of surfaces: depth in views, and the share of the sky that is open to points."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_cdt

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.sh import sh_basis
from aomgen.core.values import Array
from aomgen.splatting.rasterizer import Rendering, render

# Views are looked at in this width: a pixel is then as wide as depth is uncertain, roughly.
WIDTH_PX = 320
# Parallax that stereo works with. Depth is uncertain by a pixel's width over it; what lies less
# than that behind a drawn surface is on it.
PARALLAX_DEG = 8.0
# Views that must look through a Gaussian, and how many times as many as have it on their surface.
MIN_BEFORE, BEFORE_TO_ON = 2, 3
# Directions on the sphere that are tested: many for each of the nine coefficients.
DIRECTIONS: Final = 96
# Cells along the longest side of the occluding surface.
CELLS: Final = 64
# And of a body that is known by its Gaussians alone, which lie less dense.
BODY_CELLS: Final = 32
# Share of the light on the walls of a cavity that they send back.
BOUNCE: Final = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewDepth:
    """Depth of a view.

    Attributes:
        camera: At the map's size, any frame.
        depth: (H, W) float32, of the nearest surface; infinite where nothing stops the view, NaN
            where nothing is known.
    """

    camera: Camera
    depth: NDArray[np.float32]

    def behind(self, points: Array) -> Array:
        """Distance of points (N, 3) behind the surface, in uncertainties of depth.

        Negative before it, about -1..1 on it, NaN where the view does not look or know.
        """
        pixels, depths = self.camera.project(points)
        with np.errstate(invalid="ignore"):
            columns, rows = np.floor(np.clip(pixels, -1, 1e6)).astype(np.int64).T
        inside = (depths > 0) & (columns >= 0) & (rows >= 0)
        inside &= (columns < self.camera.width) & (rows < self.camera.height)
        drawn = self.depth[rows[inside], columns[inside]]
        result = np.full(len(points), np.nan)
        unit = np.tan(np.radians(PARALLAX_DEG)) * self.camera.fx * WIDTH_PX / self.camera.width
        result[inside] = (depths[inside] - drawn) / (depths[inside] / unit)
        return result


def view_depths(gaussians: Gaussians, cameras: list[Camera], width: int = WIDTH_PX) -> list[ViewDepth]:
    """Depth of a scene's surfaces in each view, at most `width` pixels wide."""
    result = []
    for camera in cameras:
        small = camera.narrow(width)
        drawn = np.asarray(render(gaussians, small, with_ids=True).median_depth)
        result.append(ViewDepth(camera=small, depth=np.where(drawn > 0, drawn, np.inf).astype(np.float32)))
    return result


def compute_surface_points(gaussians: Gaussians, camera: Camera) -> Array:
    """World points (H, W, 3) of the surface at each pixel, NaN where less than half of the light is stopped.

    The median depth: the mean one is no surface where a few Gaussians shine past an edge from far behind.
    """
    return compute_rendered_points(render(gaussians, camera, with_ids=True), camera)


def compute_rendered_points(drawn: Rendering, camera: Camera) -> Array:
    """As `compute_surface_points`, for an image that was rendered with ids."""
    depth = np.asarray(drawn.median_depth, np.float64)
    return camera.center + camera.directions() * np.where(depth > 0, depth, np.nan)[..., None]


def in_free_space(points: Array, views: list[ViewDepth]) -> NDArray[np.bool_]:
    """Points (N, 3) that hang where views look through: before the surface in some, on it in hardly any.

    Not checked: what is thinner than a pixel in most views hangs before their surfaces as well.
    """
    before, on = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for view in views:
        behind = view.behind(points)
        before += behind < -1
        on += np.abs(behind) <= 1
    return (before >= MIN_BEFORE) & (before > BEFORE_TO_ON * on)


def sphere_directions(count: int) -> Array:
    """Evenly spread unit directions (count, 3): a golden spiral."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + np.sqrt(5)) * k
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)


def outward_normals(points: Array, normals: Array, surface: Array) -> Array:
    """Unit normals (N, 3), turned round where their side is closed in while the other is open.

    Meshes may be wound either way. `surface` has dense points (M, 3) on everything that occludes, same frame.
    """
    solid = _Solid(surface, CELLS)
    front, back = (_transfer(points, sign * normals, solid)[1] for sign in (1.0, -1.0))
    return np.where(((front < 0.1) & (back > 0.3))[:, None], -normals, normals)


def estimate_transfer(points: Array, normals: Array, surface: Array) -> tuple[Array, Array]:
    """Transfer (N, 9) of points past a surface, as above, and the share (N,) of the sky that is open to them."""
    return _transfer(points, normals, _Solid(surface, CELLS))


def transfer_past(points: Array, normals: Array, body: Array) -> Array:
    """Transfer (N, 9) of points beside a body, of which points (M, 3) are given; nothing else is in the way."""
    return _transfer(points, normals, _Solid(body, BODY_CELLS))[0]


def open_past(points: Array, directions: Array, body: Array) -> Array:
    """Share (N,) of directions (K, 3) in which points do not meet a body, as above."""
    solid = _Solid(body, BODY_CELLS)
    return np.mean([~solid.blocks(points, direction) for direction in directions], axis=0)


def _transfer(points: Array, normals: Array, solid: "_Solid") -> tuple[Array, Array]:
    """Transfer (N, 9) and the share (N,) of the sky that is open, weighted with the cosine."""
    passed, blocked, seen = np.zeros((len(points), 9)), np.zeros((len(points), 9)), np.zeros(len(points))
    directions = sphere_directions(DIRECTIONS)
    for direction, values in zip(directions, sh_basis(directions, 2), strict=True):
        cosine = normals @ direction
        facing = np.flatnonzero(cosine > 0)
        stopped = solid.blocks(points[facing] + 1.8 * solid.cell * normals[facing], direction)
        weight = cosine[facing] * 4 / DIRECTIONS
        passed[facing] += (weight * ~stopped)[:, None] * values
        blocked[facing] += (weight * stopped)[:, None] * values
        seen[facing] += weight * ~stopped
    # Walls of a cavity are about as dark as the cavity is closed.
    return passed + BOUNCE * seen[:, None] * blocked, seen


class _Solid:
    """Cells that a surface crosses.

    Args:
        surface: Dense points (M, 3) on it.
        cells: Along its longest side.

    Attributes:
        cell: Their side.
    """

    def __init__(self, surface: Array, cells: int) -> None:
        self._low = surface.min(0)
        self.cell = float(np.ptp(surface, axis=0).max()) / cells
        shape = np.ceil(np.ptp(surface, axis=0) / self.cell).astype(int) + 3
        empty = np.ones(tuple(shape), bool)
        empty[tuple(((surface - self._low) / self.cell).astype(int).T + 1)] = False
        # Distance to the nearest solid cell, in cells; a ray may skip this many steps, each at most a cell long.
        self._free = np.asarray(distance_transform_cdt(empty, "chessboard"))

    def blocks(self, start: Array, direction: Array) -> NDArray[np.bool_]:
        """Mask of the rays from `start` (N, 3) that meet a solid cell."""
        # Rows of x, y and z: sums over three columns are slow.
        position = np.ascontiguousarray(((start - self._low) / self.cell + 1).T)
        shape, step = np.array(self._free.shape)[:, None], direction[:, None]
        # To where they enter the box of all cells.
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([-position, shape - position]) / step
        enter, leave = np.nanmax(ends.min(0), 0), np.nanmin(ends.max(0), 0)
        blocked = np.zeros(len(start), bool)
        going = np.flatnonzero((leave > 0) & (leave > enter))
        position = position[:, going] + np.maximum(enter[going] + 1e-6, 0) * step
        while len(going):
            cells = np.floor(position).astype(np.int64)
            inside = ((cells >= 0) & (cells < shape)).all(0)
            going, position = going[inside], position[:, inside]
            free = self._free[tuple(cells[:, inside])]
            blocked[going[free == 0]] = True
            on = free > 0
            going, position = going[on], position[:, on] + free[on] * step
        return blocked
