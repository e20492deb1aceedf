"""The shape of an object that was scanned closed: its panel lies in the front of one box."""

from dataclasses import dataclass

import numpy as np

from aomgen.conventions import MOVING, STATIC
from aomgen.core.values import Array
from aomgen.reconstruction.parts.panel import Panel
from aomgen.reconstruction.parts.panel_crops import Crop
from aomgen.reconstruction.parts.panel_search import BESIDE

# The seam shows at the panel's edges only, where other numbers make up for a wrong one: it is looked for from
# these places too, as shares of the panel's diagonal.
SEAM_SHARES = (0.01, 0.03)
MIN_FRONT_PIXELS = 20
# Of the numbers of `Panel.of_shape`: how far the object goes beyond the panel, never negative.
OVERHANG = [6, 7, 8, 9, 11]


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosedShapes:
    """Shapes (16,) of `Panel.of_shape`.

    Attributes:
        T_world_panel: Panel frame (4, 4).
        size: Diagonal of the panel, [m].
    """

    T_world_panel: Array
    size: float

    def panel(self, shape: Array, skin_m: float) -> Panel:
        return Panel.of_shape(self.T_world_panel, shape, skin_m)

    def extent(self, shape: Array) -> float:
        left, right, lower, upper, seam, reach = shape[:6]
        if not (left < right and lower < upper and shape[10] < seam < 0 < reach):
            return np.inf
        sizes = right - left + upper - lower - shape[10] - seam
        return float(sizes + shape[OVERHANG].sum() + shape[BESIDE].sum())

    def trials(self, shape: Array, step_m: float) -> list[Array]:
        """Each number up and down; edges of the panel also with the object's outline held still."""
        trials = []
        for index in range(BESIDE.start):
            for sign in (1.0, -1.0):
                change = np.zeros(len(shape))
                change[index] = sign * step_m
                if index < 4:
                    held = change.copy()
                    held[6 + index] = sign * step_m if index % 2 == 0 else -sign * step_m
                    trials.append(held)
                trials.append(change)
        return trials

    def bounded(self, shape: Array) -> Array:
        shape[OVERHANG] = np.maximum(shape[OVERHANG], 0)
        return shape


def first_shapes(crops: list[Crop], size_m: float) -> list[Array]:
    """Shapes (16,) to start from, by masks and by boxes alone; none where there is no common front.

    Args:
        crops: Prompted images, panel frame.
        size_m: Diagonal of the panel, [m].
    """
    tried = [_first_shape(crops, size_m, masked=masked) for masked in (True, False)]
    return [shape for shape in tried if shape is not None]


def with_seams(shape: Array, size_m: float) -> list[Array]:
    """The shape (16,), and with seams at other depths; the object's back stays behind them."""
    shapes = [shape]
    for share in SEAM_SHARES:
        changed = shape.copy()
        changed[4], changed[10] = -share * size_m, min(shape[10], -2 * share * size_m)
        shapes.append(changed)
    return shapes


def _first_shape(crops: list[Crop], size_m: float, *, masked: bool) -> Array | None:
    """A first shape from what the masks show, or from what the boxes have in common; None without a front."""
    fronts = []
    for crop in crops:
        points = crop.inside(masked=masked)
        if crop.part == MOVING:
            points = points[np.abs(points[:, 2]) < 0.05 * size_m]
            if len(points) < MIN_FRONT_PIXELS:
                return None
            fronts.append(points)
    spans = np.array([np.quantile(points, [0.03, 0.97], axis=0) for points in fronts])
    low, high = (
        (spans[:, 0].min(0), spans[:, 1].max(0)) if masked else (spans[:, 0].max(0), spans[:, 1].min(0))
    )
    everything = np.concatenate(
        [crop.inside(masked=masked) for crop in crops if crop.part == STATIC] + fronts
    )
    outer_low, outer_high = np.quantile(everything, [0.01, 0.99], axis=0)
    beyond = np.maximum(
        [low[0] - outer_low[0], outer_high[0] - high[0], low[1] - outer_low[1], outer_high[1] - high[1]], 0
    )
    seam = -0.05 * size_m
    depth = [seam, 0.2 * size_m, *beyond, min(outer_low[2], 2 * seam), 0.0]
    return np.array([low[0], high[0], low[1], high[1], *depth, *np.zeros(4)])
