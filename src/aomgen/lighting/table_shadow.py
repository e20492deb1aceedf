"""Shadow of the recorded object on its table, explained by light from many directions.

The visibility past the object is known for every cell of the table and every direction; the radiance of the
directions is fitted to the observed brightness. Dividing by the irradiance removes the shadow, soft or crisp.
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

# Cells of the top view per cell of the shadow, along a side: a shadow is smoother than the grain of wood.
COARSER: Final = 3
# Number of directions on the sphere; those with a smaller sine of the
# elevation than this hardly light a table.
DIRECTIONS, MIN_SINE = 240, 0.12
# Weight of the prior that the light is uniform, as a share of the evidence.
EVEN: Final = 0.02
# Largest gain: a larger one would not be based on observed colors, linear.
MAX_GAIN: Final = 4.0
# Brightness is smoothed over this number of cells of the shadow, a few widths of a grain.
SMOOTH: Final = 1.5
# Wood is brighter than its mean by up to this factor in some locations, linear.
GRAIN: Final = 1.1
# Only cells of which more than this share is known are used. Fewer cells than the second number do not
# distinguish a shadow from the grain; more than the third add no information.
SURE, MIN_CELLS, MAX_CELLS = 0.5, 200, 1500


@dataclass(frozen=True, kw_only=True)
class ShadowedTable:
    """A table seen from above, and the object that stood on it when it was photographed.

    Attributes:
        caster: The object, world frame.
        T_world_plane: Pose of the table, z = 0 on it.
        low: Corner of the image, plane frame (2,).
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
        """Cells of the shadow, sums (h, w, 3) of their known linear colors, and their known share (h, w)."""
        rows, columns = (-(-side // COARSER) for side in self.known.shape)
        grid = PlaneGrid(low=self.low, cell=COARSER * self.cell, columns=columns, rows=rows)
        linear = np.asarray(linear_from_srgb(self.picture_srgb), np.float64)
        colors = _pool(linear * self.known[..., None], rows, columns)
        return grid, colors, _pool(self.known.astype(float), rows, columns)


def shadow_gain(table: ShadowedTable) -> Array:
    """Compute factors (H, W, 3), 1 or more, on the light of a table that remove the shadow of its object.

    Not checked: that the table has a uniform mean color. A gradual change of its brightness from
    side to side is preserved.
    """
    known, (grid, colors, weight) = table.known, table.coarse
    gain = np.ones((*known.shape, 3))
    sure = weight > SURE
    if not sure.sum() >= MIN_CELLS:
        return gain
    directions = sphere_directions(DIRECTIONS)
    directions = directions[directions[:, 2] > MIN_SINE]
    # A uniform sky lights a table by the sine of the elevation.
    sines = directions[:, 2]
    # Visibility past the object of each direction.
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
        # Cells as bright as the lit table have no shadow to remove, whatever the sky.
        observed = gaussian_filter(colors[..., channel], SMOOTH) / np.maximum(smooth_weight, 1e-3)
        lift = np.minimum(lift, np.maximum(GRAIN * (light.sum() + slope) / np.maximum(observed, 1e-3), 1))
        fine = map_coordinates(lift, places, order=1, mode="nearest")
        gain[..., channel] = np.clip(fine, 1, MAX_GAIN)
    return gain


def select_lit_cells(table: ShadowedTable, rng: np.random.Generator) -> LitSamples:
    """Select table cells inside and outside the object's shadow; their unknown albedo is set to 1."""
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
    """Average an image (H, W, ...) over cells; it counts as 0 beyond its end."""
    more = [(0, rows * COARSER - image.shape[0]), (0, columns * COARSER - image.shape[1])]
    whole = np.pad(image, more + [(0, 0)] * (image.ndim - 2))
    return whole.reshape(rows, COARSER, columns, COARSER, *image.shape[2:]).mean((1, 3))
