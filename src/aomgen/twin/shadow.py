"""The soft shadow that an object casts on the surface it stands on, contact shadow included.

The light of every direction is stopped by what the object's silhouette covers as seen from there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from aomgen.core.gaussians import Gaussians
from aomgen.core.light import Light
from aomgen.core.sh import sh_basis
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.splatting.visibility import sphere_directions
from aomgen.twin.directional_shadow import HEIGHTS, silhouette

# Cell of the map, [m]: soft light leaves no finer detail in a shadow.
CELL: Final = 0.015
# Shadow is followed this far from the object, and fades out over the last third, [m].
REACH: Final = 0.35
# Directions of light over the whole sphere, of which half lie above the plane; the map is smoothed after.
DIRECTIONS: Final = 160
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

    T_world_plane: Matrix4
    low: Annotated[Array, "2"]
    share: Annotated[Array, "_ _"]

    __post_init__ = freeze_arrays

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


def cast_shadow(
    still: Gaussians, moving: Sequence[Gaussians], T_world_plane: ArrayLike, light: Light
) -> list[ShadowMap]:
    """Shadows of an object on a plane, one for every place of its moving part.

    Args:
        still: What does not move, at least one, world frame.
        moving: The moving part, world frame, in each of its places.
        T_world_plane: The surface (4, 4).
        light: What shines.
    """
    T = np.asarray(T_world_plane, np.float64)
    T_plane_world = invert(T)
    points = np.concatenate([apply(T_plane_world, body.means)[:, :2] for body in (still, *moving)])
    low = points.min(0) - REACH
    columns, rows = np.ceil((points.max(0) + REACH - low) / CELL).astype(int)
    x, y = np.meshgrid(low[0] + (np.arange(columns) + 0.5) * CELL, low[1] + (np.arange(rows) + 0.5) * CELL)
    cells = apply(T, np.stack([x, y, np.zeros_like(x)], -1))
    arriving, total = np.zeros((len(moving), rows, columns)), 0.0
    directions = sphere_directions(DIRECTIONS)
    for direction in directions[directions @ T[:3, 2] > 0]:
        radiance = float((sh_basis(direction[None], 2) @ light.radiance_sh).mean())
        weight = float(direction @ T[:3, 2]) * max(radiance, 0.0)
        if weight > 0:
            passed = weight * (1 - silhouette(still, direction).at(cells))
            for shares, part in zip(arriving, moving, strict=True):
                shares += passed * (1 - silhouette(part, direction).at(cells))
            total += weight
    fade = _edge_fade((rows, columns))
    maps = []
    for shares in arriving:
        share = gaussian_filter(FILL + (1 - FILL) * shares / max(total, 1e-9), 1.0)
        maps.append(ShadowMap(T_world_plane=T, low=low, share=1 - (1 - share) * fade))
    return maps


def _edge_fade(shape: tuple[int, ...]) -> Array:
    """1 inside, falling to 0 at the border of a grid over a third of the reach."""
    rows, columns = (np.minimum(np.arange(n), n - 1 - np.arange(n)) for n in shape)
    border = np.minimum(rows[:, None], columns[None]) * CELL / (REACH / 3)
    return np.clip(border, 0, 1)
