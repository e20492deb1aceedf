"""The shadow that the recorded object cast on its table, explained by light from many directions.

The visibility past the object is known for every cell of the table and every direction; the radiance of the directions is
what explains the observed brightness best. Dividing by the irradiance removes the shadow, soft or crisp.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import nnls

from aomgen.conventions import linear_from_srgb
from aomgen.core.gaussians import Gaussians
from aomgen.core.sh import sphere_directions
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.lighting.light_estimation import LitSamples
from aomgen.lighting.plane_shadow import PlaneGrid, project_shadow
from aomgen.lighting.visibility import BODY_CELLS, Occluders, estimate_transfer

# Cells of the picture from above that are one cell of the shadow, along a side: it is softer than wood is grained.
COARSER: Final = 3
# Directions over the whole sphere; those of which the sine of the elevation is less than this hardly light a table.
DIRECTIONS, MIN_SINE = 240, 0.12
# How much the light of every direction is held near that of an even sky, as a share of the evidence.
EVEN: Final = 0.02
# More than this is not made of what is seen, linear.
MAX_GAIN: Final = 4.0
# Brightness is compared over so many cells of the shadow, a few widths of a grain.
SMOOTH: Final = 1.5
# Wood is by so much brighter in some places than on the whole, linear.
GRAIN: Final = 1.1
# A cell of which more than this share is known tells; fewer such cells do not tell a shadow from the grain, and more than
# the second number tell no more.
SURE, MIN_CELLS, MAX_CELLS = 0.5, 200, 1500


@dataclass(frozen=True, kw_only=True)
class ShadowedTable:
    """A table from above, and what stood on it when it was photographed.

    Attributes:
        caster: The object, world frame.
        T_world_plane: The table, z = 0 on it.
        low: Corner of the picture, plane frame (2,).
        cell: Side of its cells, [m].
        picture_srgb: The table from above (H, W, 3).
        known: Cells (H, W) that show the table.
    """

    caster: Gaussians
    T_world_plane: Array
    low: Array
    cell: float
    picture_srgb: Array
    known: NDArray[np.bool_]

    @cached_property
    def coarse(self) -> tuple[PlaneGrid, Array, Array]:
        """Cells of the shadow: where they are, the sums (h, w, 3) of the linear colors known in them, and how much is (h, w)."""
        rows, columns = (-(-side // COARSER) for side in self.known.shape)
        grid = PlaneGrid(low=self.low, cell=COARSER * self.cell, columns=columns, rows=rows)
        linear = np.asarray(linear_from_srgb(self.picture_srgb), np.float64)
        colors = _pool(linear * self.known[..., None], rows, columns)
        return grid, colors, _pool(self.known.astype(float), rows, columns)


def shadow_gain(table: ShadowedTable) -> Array:
    """Factors (H, W, 3), 1 or more, on the light of a table that remove the shadow of what stood on it.

    Not checked: that the table has one color on the whole. Where its brightness changes evenly from side to side it is
    left so.
    """
    known, (grid, colors, weight) = table.known, table.coarse
    gain = np.ones((*known.shape, 3))
    sure = weight > SURE
    if not sure.sum() >= MIN_CELLS:
        return gain
    directions = sphere_directions(DIRECTIONS)
    directions = directions[directions[:, 2] > MIN_SINE]
    # An even sky lights a table by the sine of the elevation.
    sines = directions[:, 2]
    # What the object lets through of each.
    T_plane_world = invert(table.T_world_plane)[None, None]
    passed = 1.0 - project_shadow(table.caster, None, T_plane_world, directions, grid)[0].astype(np.float64)
    middle = grid.points()[..., :2] - grid.points()[..., :2][sure].mean(0)
    slopes = [sign * middle[..., k] for k in range(2) for sign in (1, -1)]
    A = np.stack([*passed, *slopes], -1)[sure]
    even = np.sqrt(EVEN * len(A)) * np.eye(len(passed), A.shape[1])
    smooth_weight = gaussian_filter(weight, SMOOTH)
    places = (np.indices(known.shape) + 0.5) / COARSER - 0.5
    for channel in range(3):
        seen = colors[..., channel][sure] / weight[sure]
        sky = np.median(seen) * sines / sines.sum()
        found, _ = nnls(np.concatenate([A, even]), np.concatenate([seen, even[:, : len(passed)] @ sky]))
        light, slope = found[: len(passed)], np.tensordot(found[len(passed) :], slopes, 1)
        arriving = np.tensordot(light, passed, 1) / max(float(light.sum()), 1e-9)
        lift = 1 / np.maximum(gaussian_filter(arriving, 0.5), 1 / MAX_GAIN)
        # What is as bright as the table in the light has no shadow to lose, whatever the sky.
        observed = gaussian_filter(colors[..., channel], SMOOTH) / np.maximum(smooth_weight, 1e-3)
        lift = np.minimum(lift, np.maximum(GRAIN * (light.sum() + slope) / np.maximum(observed, 1e-3), 1))
        fine = map_coordinates(lift, places, order=1, mode="nearest")
        gain[..., channel] = np.clip(fine, 1, MAX_GAIN)
    return gain


def select_lit_cells(table: ShadowedTable, rng: np.random.Generator) -> LitSamples:
    """Places of a table in the shadow of what stood on it and beside it. Their albedo is not known, 1."""
    grid, colors, weight = table.coarse
    sure = np.argwhere(weight > SURE)
    if not len(sure) >= MIN_CELLS:
        sure = sure[:0]
    sure = tuple(rng.permutation(sure)[:MAX_CELLS].T)
    points = apply(table.T_world_plane, grid.points()[sure])
    up = np.tile(table.T_world_plane[:3, 2], (len(points), 1))
    occluders = Occluders(table.caster.means.astype(np.float64), BODY_CELLS)
    return LitSamples(
        transfer=estimate_transfer(points, up, occluders)[0],
        albedo=np.ones((len(points), 3)),
        seen=colors[sure] / weight[sure][:, None],
    )


def _pool(image: Array, rows: int, columns: int) -> Array:
    """Means over cells of an image (H, W, ...), 0 beyond its end."""
    more = [(0, rows * COARSER - image.shape[0]), (0, columns * COARSER - image.shape[1])]
    whole = np.pad(image, more + [(0, 0)] * (image.ndim - 2))
    return whole.reshape(rows, COARSER, columns, COARSER, *image.shape[2:]).mean((1, 3))
