"""How shadows darken the scene in an episode's images, frame by frame."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, median_filter
from scipy.sparse import csr_array

from aomgen.conventions import SRGB_POWER
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.light import Light
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import RigidParts
from aomgen.twin.plane_shadow import PlaneGrid, SoftShadow, project_shadow
from aomgen.twin.shadow import FAR, MOVES, STANDS, DirectionalLight, intersect_surface, silhouette
from aomgen.twin.thing_shadow import ThingShadow, compute_surrounding_shadow
from aomgen.twin.twin import OBJECT, PART, TwinModel, pose_bodies, shadow_roles

# Cell of a map of the robot's crisp shadow, [m]: about a pixel.
CRISP_CELL = 0.004
# Shadows of a wide lamp are softer: their cells are so many times as wide.
WIDE_CELLS = 3
# Places of walls and things on which the object's shadow is computed.
THINGS = 2000
# Nothing that hangs on an arm throws a shadow farther from its base than this, [m].
SHADOW_REACH = 2.5


class States(NamedTuple):
    """Of what moves in T frames: poses of the twin's bodies (T, B, 4, 4), joint values of the object (T,)."""

    Ts_world_body: Array
    thetas: Array

    def part(self, frames: slice) -> "States":
        """Some of the frames."""
        return States(self.Ts_world_body[frames], self.thetas[frames])


class DarkMaps(NamedTuple):
    """Share (T, rows, columns) of the light that is taken in cells on a surface, linear; nothing beside them."""

    grid: PlaneGrid
    shares: NDArray[np.float32]


class Shade(Protocol):
    """A shadow on a surface.

    Attributes:
        T_world_plane: The surface it falls on.
        T_world_grid: Frame of the cells.
        grid: Cells of its maps.
    """

    T_world_plane: Array
    T_world_grid: Array
    grid: PlaneGrid

    def dark(self, states: States) -> DarkMaps:
        """What it takes."""
        ...


class SoftShade:
    """The shadow that the object throws in the light from all around, but for a lamp's, which is left to `CrispShade`."""

    def __init__(
        self, twin: TwinModel, T_world_object: Array, soft: SoftShadow, T_world_plane: Array
    ) -> None:
        self.T_world_plane, self.grid = T_world_plane, soft.grid
        self.T_world_grid = T_world_object @ soft.T_object_plane
        light, lamp, rest = _object_light(twin), twin.directional_light, 1.0
        if lamp is not None:
            light, rest = light.without(lamp.direction, T_world_plane[:3, 2], lamp.share), 1 - lamp.share
        self._dark = np.float32(rest) * (1 - soft.arriving(light, T_world_object))
        self._soft = soft

    def dark(self, states: States) -> DarkMaps:
        """What it takes."""
        dark = self._soft.states(states.thetas) @ self._dark.reshape(len(self._dark), -1)
        return DarkMaps(self.grid, dark.reshape(-1, *self._dark.shape[1:]))


class CrispShade:
    """The shadow that the robot and the object's part throw in a directional light, crisp or wide.

    The object's static part throws one too `with_static`; elsewhere the scan shows it.

    Cells do not depend on what moves where, so that equal states give equal pictures.

    The grid covers what is seen (N, 3) of the surface.
    """

    def __init__(
        self,
        twin: TwinModel,
        robot: RobotModel,
        Ts_world_body: Array,
        seen_world: Array,
        *,
        with_static: bool,
        threads: int | None,
    ) -> None:
        light, roles = _lamp(twin), shadow_roles(twin, robot)
        moving, new = roles == MOVES, with_static & (twin.bodies == twin.body(OBJECT))
        self.T_world_plane = self.T_world_grid = light.T_world_plane
        self._to_plane = invert(light.T_world_plane)
        self._bodies, self._parts, self._threads = twin.gaussians.select(moving), twin.bodies[moving], threads
        self._directions = light.directions @ self._to_plane[:3, :3].T
        cell = CRISP_CELL * (WIDE_CELLS if light.width else 1)
        self._boxes = _body_corners(self._bodies, self._parts)
        self.grid = _cells_over(apply(self._to_plane, seen_world)[:, :2], self._to_plane[:2, 3], cell)
        places = apply(light.T_world_plane, self.grid.points())

        def measure_light_beside(chosen: NDArray[np.bool_]) -> Array:
            """Share (K, rows, columns) of the light of each direction that some of what stands lets through."""
            poses = RigidParts(indices=twin.bodies[chosen], Ts_world_part=Ts_world_body)
            standing = twin.gaussians.select(chosen)
            return np.stack([1 - silhouette(standing, way, poses).at(places) for way in light.directions])

        share = light.share / len(self._directions) * measure_light_beside((roles == STANDS) & ~new)
        passed = measure_light_beside(new)
        self._still = (share * (1 - passed)).sum(0).astype(np.float32)
        self._shares = (share * passed).astype(np.float32)

    def dark(self, states: States) -> DarkMaps:
        """What it takes, in those cells where it may fall in any of the frames."""
        Ts = self._to_plane @ states.Ts_world_body
        rows, columns = self._bound_shadows(Ts)
        window = self.grid.window(rows, columns)
        dark = np.tile(self._still[rows, columns], (len(Ts), 1, 1))
        for direction, share in zip(self._directions, self._shares, strict=True):
            ways = np.tile(direction, (len(Ts), 1))
            cast = project_shadow(self._bodies, self._parts, Ts, ways, window, self._threads)
            dark += share[rows, columns] * cast
        return DarkMaps(window, dark)

    def _bound_shadows(self, Ts_plane_body: Array) -> tuple[slice, slice]:
        """Rows and columns of the grid that hold all shadows, of bodies by their boxes; at least one of each."""
        slopes, grid = self._directions[:, :2] / self._directions[:, 2:], self.grid
        places = [apply(Ts_plane_body[:, None, body], corners) for body, corners in self._boxes.items()]
        dark = grid.points()[self._still > 0, :2]
        cast = np.concatenate(
            [
                dark,
                *(
                    (item[..., :2] - item[..., 2:] * slope).reshape(-1, 2)
                    for item in places
                    for slope in slopes
                ),
            ]
        )
        if not len(cast):
            return slice(0, 1), slice(0, 1)
        low, high = (
            np.floor((bound - grid.low) / grid.cell).astype(int) for bound in (cast.min(0), cast.max(0))
        )
        (x, y), size = np.clip(low, 0, None), np.array([grid.columns, grid.rows])
        to_x, to_y = np.minimum(high + 1, size)
        if not (x < to_x and y < to_y):
            return slice(0, 1), slice(0, 1)
        return slice(int(y), int(to_y)), slice(int(x), int(to_x))


def _body_corners(gaussians: Gaussians, bodies: NDArray[np.int32]) -> dict[int, Array]:
    """Corners (8, 3) of the box about the Gaussians of each body, body frame."""
    corners = {}
    for body in np.unique(bodies).tolist():
        own = gaussians.means[bodies == body]
        sides = np.stack([own.min(0), own.max(0)], 1)
        corners[body] = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)
    return corners


def _cells_over(places: Array, base: Array, cell: float) -> PlaneGrid:
    """Cells of a size over places (N, 2) on a surface near the robot's base (2,), corners at multiples of it."""
    places = np.clip(places, base - SHADOW_REACH, base + SHADOW_REACH)
    if not len(places):
        return PlaneGrid(low=np.zeros(2), cell=cell, columns=1, rows=1)
    first, last = (np.floor(bound / cell).astype(int) for bound in (places.min(0), places.max(0)))
    columns, rows = (last - first + 3).tolist()
    return PlaneGrid(low=(first - 1) * cell, cell=cell, columns=columns, rows=rows)


def shade_on_things(
    twin: TwinModel, Ts_world_body: Array, eyes_world: Array, T_world_plane: Array
) -> ThingShadow:
    """The shadow of a lit object on walls and things, for one state: they lie behind it more than before its part."""
    bodies = [twin.body(OBJECT), twin.body(PART)]
    body = pose_bodies(twin.select(np.isin(twin.bodies, bodies)), Ts_world_body)
    scene, lamp = twin.gaussians.select(twin.bodies == 0), twin.directional_light
    return compute_surrounding_shadow(
        scene, body, _object_light(twin), lamp, eyes_world, T_world_plane, THINGS
    )


def _object_light(twin: TwinModel) -> Light:
    """What the object is lit by, which `compute_soft_shadow` has found to be lit."""
    relit = twin.relit
    if relit is None:
        raise ValueError("the twin's object is not lit")
    return relit.lights[relit.light_of[np.flatnonzero(twin.relit_bodies == twin.body(OBJECT))[0]]]


def _lamp(twin: TwinModel) -> DirectionalLight:
    if twin.directional_light is None:
        raise ValueError("the twin has no directional light")
    return twin.directional_light


@dataclass(frozen=True, slots=True, kw_only=True)
class ShadedPixels:
    """Pixels of a fixed camera that show a surface with a shadow.

    Attributes:
        pixels: (N,) indices into H * W.
        share: How much of their color is the surface's (N,), 0..1.
        grid: Cells that may be dark.
        lookup: Matrix (N, cells) that interpolates a map there.
    """

    pixels: NDArray[np.int64]
    share: NDArray[np.float32]
    grid: PlaneGrid
    lookup: csr_array

    def taken(self, dark: DarkMaps) -> NDArray[np.float32]:
        """Light taken (T, N) from their colors by maps of the grid, or of a window of it."""
        maps = dark.shares
        if dark.grid is not self.grid:
            column, row = np.rint((dark.grid.low - self.grid.low) / self.grid.cell).astype(int)
            maps = np.zeros((len(maps), self.grid.rows, self.grid.columns), np.float32)
            maps[:, row : row + dark.grid.rows, column : column + dark.grid.columns] = dark.shares
        return self.share * (self.lookup @ np.ascontiguousarray(maps.reshape(len(maps), -1).T)).T


def find_shaded_pixels(
    shade: Shade, camera: Camera, depth: NDArray[np.float32], scene_share: NDArray[np.float32]
) -> ShadedPixels:
    """Where a fixed camera sees the surface, by depth (H, W) and the scene's share of the colors (H, W)."""
    far = np.minimum(depth, FAR).astype(np.float64)
    points, belongs = intersect_surface(shade.T_world_plane, camera, far)
    # Single pixels of an outline may lie behind it.
    share = (median_filter(belongs, 3) * scene_share).astype(np.float32).ravel()
    seen = np.flatnonzero(share > 0)
    lookup = shade.grid.lookup(apply(invert(shade.T_world_grid), points.reshape(-1, 3)[seen])[:, :2])
    hit = lookup.sum(1) > 0
    return ShadedPixels(pixels=seen[hit], share=share[seen[hit]], grid=shade.grid, lookup=lookup[hit])


def measure_occlusion(
    shade: Shade, dark: DarkMaps, frame: int, camera: Camera, depth: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Share (H, W) of the light on the surface that is taken in one frame, where a camera sees it at depth (H, W)."""
    points, belongs = intersect_surface(shade.T_world_plane, camera, depth.astype(np.float64))
    seen = belongs > 0
    places = apply(invert(shade.T_world_grid), points[seen])[:, :2]
    cells = ((places - dark.grid.low) / dark.grid.cell - 0.5).T[::-1]
    taken = np.zeros(depth.shape, np.float32)
    taken[seen] = belongs[seen] * map_coordinates(dark.shares[frame], cells, order=1)
    return taken


def color_factors(taken: NDArray[np.float32]) -> NDArray[np.float32]:
    """Factors on sRGB colors where shares of the light are taken."""
    return np.maximum(1 - taken, 0) ** np.float32(SRGB_POWER)
