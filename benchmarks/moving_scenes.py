"""Scenes with moving parts before a fixed camera, for render sessions."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians, concatenate
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.core.values import Array, Vector3, freeze_arrays
from aomgen.splatting.rasterizer import render
from benchmarks.scenes import FIRST_OBJECT, ellipsoids, table_top, table_top_surfaces

TILE_PX = 16
PERIOD_FRAMES = 24


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingScene:
    """Static Gaussians, and P parts that swing about a vertical axis.

    Attributes:
        camera: The fixed view.
        static: Static Gaussians, world frame.
        moving: Moving Gaussians, world frame at rest.
        parts: Part of every moving Gaussian (M,) int32.
        swings_deg: Amplitude of each part's swing (P,).
        pivot: Point on the axis (3,), world frame, [m].
    """

    camera: Camera
    static: Gaussians
    moving: Annotated[Gaussians, "N"]
    parts: Annotated[NDArray[np.int32], "N"]
    swings_deg: Annotated[Array, "_"]
    pivot: Vector3

    def __post_init__(self) -> None:
        freeze_arrays(self)
        freeze_arrays(self)

    def Ts_world_part(self, frame: int) -> Array:
        """Compute poses of the parts (P, 4, 4) relative to rest; neighboring frames always differ."""
        phase = np.sin(2 * np.pi * (frame + 0.3) / PERIOD_FRAMES)
        angles = np.radians(self.swings_deg) * phase
        R = matrix_from_rotvec(angles[:, None] * [0.0, 0.0, 1.0])
        return transform(R, self.pivot - R @ self.pivot)


def objects_scene(count: int, camera: Camera, share: float) -> MovingScene:
    """Make the table-top scene, in which the round objects nearest to the camera sway.

    The number of moving objects is chosen so that they are visible in a share of
    the tiles, as nearly as possible.
    """
    gaussians, surfaces = table_top_surfaces(count, 3)
    objects = np.unique(surfaces[surfaces >= FIRST_OBJECT])
    depths = [camera.project(gaussians.means[surfaces == item])[1].mean() for item in objects]
    nearest = objects[np.argsort(depths)]
    seen = [touched_tiles(gaussians.select(surfaces == item), camera) for item in nearest]
    shares = np.logical_or.accumulate(seen).mean((1, 2))
    moves = np.isin(surfaces, nearest[: int(np.abs(shares - share).argmin()) + 1])
    return MovingScene(
        camera=camera,
        static=gaussians.select(~moves),
        moving=gaussians.select(moves),
        parts=np.zeros(int(moves.sum()), np.int32),
        swings_deg=np.array([1.0]),
        pivot=np.array([0, 0, 0.1]),
    )


def arm_scene(static: int, moving: int, camera: Camera) -> MovingScene:
    """Make the table-top scene with a swinging arm of eight links over it, and an object with a door.

    Harmonics are of degree 2 and parts are in order, as in twins.
    """
    along = np.linspace(0, 1, 8)
    links = np.stack([0.6 - 0.55 * along, 0.1 - 0.45 * along, 0.1 + 1.5 * along * (1.2 - along)], 1)
    thickness = np.linspace(0.14, 0.08, 8)[:, None] * [1.0, 1.0, 1.4]
    centers = np.concatenate([links, [[-0.35, 0.0, 0.22], [-0.35, -0.2, 0.22]]])
    radii = np.concatenate([thickness, [[0.28, 0.2, 0.2], [0.25, 0.04, 0.18]]])
    parts = np.arange(moving) % len(centers)
    order = np.argsort(parts, kind="stable")
    return MovingScene(
        camera=camera,
        static=table_top(static, 2),
        moving=ellipsoids(moving, centers, radii, 2, seed=1).select(order),
        parts=parts[order].astype(np.int32),
        swings_deg=np.append(np.linspace(1, 8, 8), [0.0, 4.0]),
        pivot=np.array([0, 0.45, 0]),
    )


def touched_share(scene: MovingScene, frame: int) -> float:
    """Compute the share of tiles in which moving Gaussians are visible in a frame or in the previous one."""
    frames = (frame - 1, frame)
    return float(np.logical_or.reduce([touched_tiles(moved(scene, f), scene.camera) for f in frames]).mean())


def touched_tiles(gaussians: Gaussians, camera: Camera) -> NDArray[np.bool_]:
    """Find tiles (rows, columns) of the image in which Gaussians, rendered alone, are visible."""
    columns, rows = -(-camera.width // TILE_PX), -(-camera.height // TILE_PX)
    seen = np.zeros((rows * TILE_PX, columns * TILE_PX), bool)
    seen[: camera.height, : camera.width] = render(gaussians, camera).alpha > 0
    return np.asarray(seen.reshape(rows, TILE_PX, columns, TILE_PX).any((1, 3)))


def moved(scene: MovingScene, frame: int) -> Gaussians:
    """Move the moving Gaussians to a frame, world frame; harmonics rotate with them."""
    Ts = scene.Ts_world_part(frame)
    return concatenate([scene.moving.select(scene.parts == part).transform(T) for part, T in enumerate(Ts)])
