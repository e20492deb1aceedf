"""How shadows darken the scene in an episode's images, frame by frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.sparse import csr_array

from aomgen.core.camera import Camera
from aomgen.core.light import Light
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import RigidParts
from aomgen.twin.plane_shadow import PlaneGrid, SoftShadow, cast_on_plane
from aomgen.twin.shadow import FAR, MOVES, STANDS, DirectionalLight, intersect_surface, silhouette
from aomgen.twin.twin import OBJECT, PART, Twin, shadow_roles

# Cell of a map of the robot's crisp shadow, [m]: about a pixel.
CRISP_CELL = 0.004


class SoftShade:
    """The shadow that the object throws in the light from all around.

    Attributes:
        T_world_plane: The surface it falls on.
        T_world_grid: Frame of the cells.
        grid: Cells of its maps.
    """

    def __init__(
        self, twin: Twin, thetas: Array, T_world_object: Array, soft: SoftShadow, T_world_plane: Array
    ):
        self.T_world_plane, self.grid = T_world_plane, soft.grid
        self.T_world_grid = T_world_object @ soft.T_object_plane
        arriving = soft.arriving(_object_light(twin), T_world_object)
        # sRGB is close to the power 1 / 2.2 of linear light.
        self._dark = 1 - np.maximum(arriving, 0) ** np.float32(1 / 2.2)
        self._states = soft.states(thetas)

    def dark(self, frames: slice) -> NDArray[np.float32]:
        """Share (T, rows, columns) of the sRGB color that it takes."""
        dark = self._states[frames] @ self._dark.reshape(len(self._dark), -1)
        return dark.reshape(-1, *self._dark.shape[1:])


class CrispShade:
    """The shadow that the robot, and the object's part `with_part`, throws in a directional light.

    Attributes: As of `SoftShade`.
    """

    def __init__(
        self,
        twin: Twin,
        robot: RobotModel,
        Ts_world_body: Array,
        points_world: Sequence[Array],
        *,
        with_part: bool,
        threads: int | None,
    ) -> None:
        light, roles = _lamp(twin), shadow_roles(twin, robot)
        moving, stands = (roles == MOVES) & (with_part | (twin.bodies != twin.body(PART))), roles == STANDS
        self.T_world_plane = self.T_world_grid = light.T_world_plane
        to_plane = invert(light.T_world_plane)
        self._bodies, self._parts, self._threads = twin.gaussians.select(moving), twin.bodies[moving], threads
        self._direction, self._Ts = to_plane[:3, :3] @ light.direction, to_plane @ Ts_world_body
        self.grid = self._reached(
            [apply(to_plane, points)[..., :2].reshape(-1, 2) for points in points_world]
        )
        places = self.grid.low + (np.indices((self.grid.columns, self.grid.rows)).T + 0.5) * self.grid.cell
        cells = apply(light.T_world_plane, np.concatenate([places, np.zeros_like(places[..., :1])], -1))
        poses = RigidParts(indices=twin.bodies[stands], Ts_world_part=Ts_world_body[0])
        lit = 1 - silhouette(twin.gaussians.select(stands), light.direction, poses).at(cells)
        self._share = ((1 - light.shade.mean()) * lit).astype(np.float32)

    def dark(self, frames: slice) -> NDArray[np.float32]:
        """Share (T, rows, columns) of the sRGB color that it takes."""
        Ts = self._Ts[frames]
        directions = np.tile(self._direction, (len(Ts), 1))
        return self._share * cast_on_plane(
            self._bodies, self._parts, Ts, directions, self.grid, self._threads
        )

    def _reached(self, seen: Sequence[Array]) -> PlaneGrid:
        """Cells where shadow may fall, within the bounds of what is seen."""
        boxes, slope = [np.zeros((0, 2))], self._direction[:2] / self._direction[2]
        for body in np.unique(self._parts):
            own = self._bodies.means[self._parts == body]
            sides = np.stack([own.min(0), own.max(0)], 1)
            corners = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)
            places = apply(self._Ts[:, None, body], corners)
            boxes.append((places[..., :2] - places[..., 2:] * slope).reshape(-1, 2))
        cast, met = np.concatenate(boxes), np.concatenate([np.zeros((0, 2)), *seen])
        if not len(cast) or not len(met):
            return PlaneGrid(low=np.zeros(2), cell=CRISP_CELL, columns=1, rows=1)
        low, high = np.maximum(cast.min(0), met.min(0)), np.minimum(cast.max(0), met.max(0))
        columns, rows = np.maximum(np.ceil((high - low) / CRISP_CELL), 0).astype(int).tolist()
        return PlaneGrid(low=low - CRISP_CELL, cell=CRISP_CELL, columns=columns + 2, rows=rows + 2)


Shade = SoftShade | CrispShade


def _object_light(twin: Twin) -> Light:
    """What the object is lit by, which `cast_soft_shadow` has found to be lit."""
    relit = twin.relit
    if relit is None:
        raise ValueError("the twin's object is not lit")
    return relit.lights[relit.light_of[np.flatnonzero(twin.relit_bodies == twin.body(OBJECT))[0]]]


def _lamp(twin: Twin) -> DirectionalLight:
    if twin.directional_light is None:
        raise ValueError("the twin has no directional light")
    return twin.directional_light


@dataclass(frozen=True, slots=True, kw_only=True)
class ShadedPixels:
    """Pixels of a fixed camera that show a surface with a shadow.

    Attributes:
        pixels: (N,) indices into H * W.
        share: How much of their color is the surface's (N,), 0..1.
        lookup: Matrix (N, cells) that interpolates a map there.
    """

    pixels: NDArray[np.int64]
    share: NDArray[np.float32]
    lookup: csr_array

    def factors(self, dark: NDArray[np.float32]) -> NDArray[np.float32]:
        """Factors (T, N) on their colors for maps (T, rows, columns)."""
        maps = np.ascontiguousarray(dark.reshape(len(dark), -1).T)
        return 1 - self.share * (self.lookup @ maps).T


def find_shaded_pixels(
    shade: Shade, camera: Camera, depth: NDArray[np.float32], scene_share: NDArray[np.float32]
) -> ShadedPixels:
    """Where a fixed camera sees the surface, by depth (H, W) and the scene's share of the colors (H, W)."""
    far = np.minimum(depth, FAR).astype(np.float64)
    points, belongs = intersect_surface(shade.T_world_plane, camera, far)
    share = (belongs * scene_share).astype(np.float32).ravel()
    seen = np.flatnonzero(share > 0)
    lookup = shade.grid.lookup(apply(invert(shade.T_world_grid), points.reshape(-1, 3)[seen])[:, :2])
    hit = lookup.sum(1) > 0
    return ShadedPixels(pixels=seen[hit], share=share[seen[hit]], lookup=lookup[hit])


def shaded_factors(
    shade: Shade, dark: NDArray[np.float32], camera: Camera, depth: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Factors (H, W) on the colors of the surface, where a camera sees it at depth (H, W), in one frame's map."""
    points, belongs = intersect_surface(shade.T_world_plane, camera, depth.astype(np.float64))
    seen = belongs > 0
    places = apply(invert(shade.T_world_grid), points[seen])[:, :2]
    cells = ((places - shade.grid.low) / shade.grid.cell - 0.5).T[::-1]
    factors = np.ones(depth.shape, np.float32)
    factors[seen] -= (belongs[seen] * map_coordinates(dark, cells, order=1)).astype(np.float32)
    return factors
