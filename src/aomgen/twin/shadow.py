"""The shadow that an object casts on the surface it stands on, contact shadow included.

For every cell of the surface, the light that reaches it past the object is compared with the
light without the object. The object is a column in each cell, from its lowest to its highest
point.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from aomgen.core.light import Light
from aomgen.core.sh import sh_basis
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze

# Cell of the height field, [m]: soft light leaves no finer detail in a shadow.
CELL: Final = 0.015
# Shadow is followed this far from the object, and fades out over the last third, [m].
REACH: Final = 0.35
# Directions of light on the hemisphere above the plane; the map is smoothed after.
AZIMUTHS: Final = 16
# See above: 80 directions in all.
ELEVATIONS: Final = 5
# Heights over which a seen point fades in and out of the surface, [m]. Depth of trained
# surfaces is uncertain, mostly downwards, because lower Gaussians shine through.
HEIGHTS: Final = (-0.09, -0.06, 0.012, 0.03)
# Light that things around throw into a shadow, as a share of what is blocked.
FILL: Final = 0.15


@dataclass(frozen=True, slots=True, kw_only=True)
class ShadowMap:
    """Share of light that still arrives.

    Attributes:
        T_world_plane: Frame of the surface (4, 4), z = 0 on it.
        low: Corner (2,) of cell (0, 0), plane frame, [m].
        share: (H, W), 0..1, linear.
    """

    T_world_plane: Array
    low: Array
    share: Array

    def __post_init__(self) -> None:
        freeze(self, "T_world_plane", self.T_world_plane, (4, 4))
        freeze(self, "low", self.low, (2,))
        freeze(self, "share", self.share, (None, None))

    def at(self, points_world: ArrayLike, eye_world: ArrayLike) -> NDArray[np.float32]:
        """Factor on sRGB values (...,) at points (..., 3) seen from an eye (3,); 1 off the surface.

        The shadow is looked up where the line of sight meets the surface.
        """
        T_plane_world = invert(self.T_world_plane)
        places, eye = apply(T_plane_world, points_world), apply(T_plane_world, eye_world)
        heights = places[..., 2]
        along = eye[2] / np.maximum(eye[2] - heights, 1e-6)
        met = eye[:2] + along[..., None] * (places[..., :2] - eye[:2])
        cells = (met - self.low) / CELL - 0.5
        share = map_coordinates(self.share, [cells[..., 1], cells[..., 0]], order=1, cval=1.0)
        # sRGB is close to the power 1 / 2.2 of linear light.
        factor = np.maximum(share, 0) ** (1 / 2.2)
        belongs = np.interp(heights, HEIGHTS, (0.0, 1.0, 1.0, 0.0))
        return (1 - belongs * (1 - factor)).astype(np.float32)


def cast_shadow(points_world: ArrayLike, T_world_plane: ArrayLike, light: Light) -> ShadowMap:
    """Shadow of an object on a plane.

    Args:
        points_world: Dense points on the object (N, 3), at least one.
        T_world_plane: The surface (4, 4).
        light: What shines.
    """
    T = np.asarray(T_world_plane, np.float64)
    points = apply(invert(T), points_world)
    low = points[:, :2].min(0) - REACH
    size = np.ceil((points[:, :2].max(0) + REACH - low) / CELL).astype(int)
    columns, rows = ((points[:, :2] - low) / CELL).astype(int).T
    bottom = np.full((size[1], size[0]), np.inf)
    top = np.full((size[1], size[0]), -np.inf)
    np.minimum.at(bottom, (rows, columns), points[:, 2])
    np.maximum.at(top, (rows, columns), points[:, 2])
    radiance = light.seen_from(T[:3, :3])
    arriving, total = np.zeros(top.shape), 0.0
    elevations = (np.arange(ELEVATIONS) + 0.5) / ELEVATIONS * np.pi / 2
    for elevation in elevations:
        for turn in np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS:
            flat = np.array([np.cos(turn), np.sin(turn)])
            direction = np.append(np.cos(elevation) * flat, np.sin(elevation))
            # Cosine on the plane times the ring's solid angle.
            weight = np.sin(elevation) * np.cos(elevation)
            weight *= max(float((sh_basis(direction[None], 2) @ radiance).mean()), 0.0)
            arriving += weight * ~_blocked(bottom, top, flat, float(np.tan(elevation)))
            total += weight
    share = arriving / max(total, 1e-9)
    share = gaussian_filter(FILL + (1 - FILL) * share, 1.0)
    return ShadowMap(T_world_plane=T, low=low, share=1 - (1 - share) * _edge_fade(share.shape))


def _blocked(bottom: Array, top: Array, flat: Array, slope: float) -> NDArray[np.bool_]:
    """Which cells (H, W) do not see a direction, because a column stands in the way."""
    blocked = bottom < 2 * CELL
    highest = float(top.max())
    steps = int(min(highest / max(slope, 1e-6), float(np.linalg.norm(bottom.shape)) * CELL) / CELL) + 1
    for step in range(1, steps + 1):
        right, up = (int(n) for n in np.rint(flat * step))
        ray = step * CELL * slope
        hit = (top > ray) & (bottom < ray + CELL * max(slope, 1.0))
        blocked |= _shifted(hit, -up, -right)
    return blocked


def _shifted(grid: NDArray[np.bool_], rows: int, columns: int) -> NDArray[np.bool_]:
    """The grid moved by whole cells, False coming in."""
    height, width = grid.shape
    result = np.zeros_like(grid)
    if abs(rows) < height and abs(columns) < width:
        into = (slice(max(rows, 0), height + min(rows, 0)), slice(max(columns, 0), width + min(columns, 0)))
        out = (
            slice(max(-rows, 0), height + min(-rows, 0)),
            slice(max(-columns, 0), width + min(-columns, 0)),
        )
        result[into] = grid[out]
    return result


def _edge_fade(shape: tuple[int, ...]) -> Array:
    """1 inside, falling to 0 at the border of a grid over a third of the reach."""
    rows, columns = (np.minimum(np.arange(n), n - 1 - np.arange(n)) for n in shape)
    border = np.minimum(rows[:, None], columns[None]) * CELL / (REACH / 3)
    return np.clip(border, 0, 1)
