"""Remove the shadow of the recorded object from its table, by a fit of light from many directions.

For every cell of the table and every direction, the visibility past the object is computed. The radiance of the directions
is fitted to the observed brightness. Division by the resulting irradiance removes the shadow, whether soft or sharp.
"""

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
from aomgen.twin.plan_view import PlanView

# Number of cells of the top view per cell of the shadow, along each side; a shadow is smoother than the grain of wood.
COARSER: Final = 3
# Number of directions on the sphere, and smallest sine of the elevation; lower directions hardly illuminate a table.
DIRECTIONS, MIN_SINE = 240, 0.12
# Weight of the prior that the light is uniform, relative to the weight of all observations.
EVEN: Final = 0.02
# Largest gain on linear colors; a larger one would mostly amplify noise.
MAX_GAIN: Final = 4.0
# Standard deviation of the filter that smooths the brightness, in cells of the shadow; it spans several lines of grain.
SMOOTH: Final = 1.5
# Largest ratio of the smoothed linear brightness of an unshadowed table to its mean, due to the grain of wood.
GRAIN: Final = 1.1
# Smallest known share of a cell that is used; smallest number of such cells, with which a shadow can be distinguished from
# grain; and largest number of sampled cells.
SURE, MIN_CELLS, MAX_CELLS = 0.5, 200, 1500


def shadow_gain(caster: Gaussians, plan: PlanView, picture_srgb: Array, known: NDArray[np.bool_]) -> Array:
    """Compute factors (H, W, 3), >= 1, on the linear colors of a table that remove the shadow of its object.

    Args:
        caster: Object that stood on the table during the scan, world frame.
        plan: Cells of the top view of the table.
        picture_srgb: Top view (H, W, 3).
        known: Mask (H, W) of the cells that show the table.

    Not checked: whether the table has a uniform mean color. A linear change of its brightness across the table is preserved.
    """
    grid, colors, weight = _coarsen(plan, picture_srgb, known)
    gain = np.ones((*known.shape, 3))
    sure = weight > SURE
    if not sure.sum() >= MIN_CELLS:
        return gain
    directions = sphere_directions(DIRECTIONS)
    directions = directions[directions[:, 2] > MIN_SINE]
    # Under a uniform sky, the irradiance from a direction is proportional to the sine of its elevation.
    sines = directions[:, 2]
    # `passed` is the visibility of each direction past the object.
    T_plane_world = invert(plan.support.T_world_plane)[None, None]
    passed = 1.0 - project_shadow(caster, None, T_plane_world, directions, grid)[0].astype(np.float64)
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
        # The gain is limited so that cells that are already as bright as the unshadowed table are not brightened.
        observed = gaussian_filter(colors[..., channel], SMOOTH) / np.maximum(smooth_weight, 1e-3)
        lift = np.minimum(lift, np.maximum(GRAIN * (light.sum() + slope) / np.maximum(observed, 1e-3), 1))
        fine = map_coordinates(lift, places, order=1, mode="nearest")
        gain[..., channel] = np.clip(fine, 1, MAX_GAIN)
    return gain


def select_lit_cells(
    caster: Gaussians, plan: PlanView, picture_srgb: Array, known: NDArray[np.bool_], rng: np.random.Generator
) -> LitSamples:
    """Sample table cells inside and outside the object's shadow; their albedo is unknown and set to 1.

    See `shadow_gain` for the arguments.
    """
    grid, colors, weight = _coarsen(plan, picture_srgb, known)
    sure = np.argwhere(weight > SURE)
    if not len(sure) >= MIN_CELLS:
        sure = sure[:0]
    sure = tuple(rng.permutation(sure)[:MAX_CELLS].T)
    T_world_plane = plan.support.T_world_plane
    points = apply(T_world_plane, grid.points()[sure])
    up = np.tile(T_world_plane[:3, 2], (len(points), 1))
    occluders = Occluders(caster.means.astype(np.float64), BODY_CELLS)
    return LitSamples(
        transfer=estimate_transfer(points, up, occluders)[0],
        albedo=np.ones((len(points), 3)),
        seen=colors[sure] / weight[sure][:, None],
    )


def _coarsen(plan: PlanView, picture_srgb: Array, known: NDArray[np.bool_]) -> tuple[PlaneGrid, Array, Array]:
    """Return cells of the shadow, their linear colors (h, w, 3) times their known share, and the known share (h, w)."""
    rows, columns = (-(-side // COARSER) for side in known.shape)
    grid = PlaneGrid(low=plan.low, cell=COARSER * plan.cell, columns=columns, rows=rows)
    linear = np.asarray(linear_from_srgb(picture_srgb), np.float64)
    colors = _pool(linear * known[..., None], rows, columns)
    return grid, colors, _pool(known.astype(float), rows, columns)


def _pool(image: Array, rows: int, columns: int) -> Array:
    """Average an image (H, W, ...) over the cells of the shadow; the image is padded with zeros."""
    more = [(0, rows * COARSER - image.shape[0]), (0, columns * COARSER - image.shape[1])]
    whole = np.pad(image, more + [(0, 0)] * (image.ndim - 2))
    return whole.reshape(rows, COARSER, columns, COARSER, *image.shape[2:]).mean((1, 3))
