"""Finding the panel (see `panel`) that explains the boxes a person drew.

A box drawn around a part touches it on all four sides, in every prompted image at once: that is
stronger evidence than any single mask. Masks that fill their box count beside it, those that do
not (a window instead of its door) are left out.
"""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.conventions import MOVING
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.reconstruction.parts.panel import Panel
from aomgen.reconstruction.parts.panel_closed import ClosedShapes, first_shapes, with_seams
from aomgen.reconstruction.parts.panel_crops import Crop, PromptedView
from aomgen.reconstruction.parts.panel_front import panel_frame
from aomgen.reconstruction.parts.panel_open import open_shapes, panel_size, with_air
from aomgen.reconstruction.parts.panel_search import COARSE_STEPS, FINE_STEPS, Search

STAGE = "parts"
COARSE_PIXELS, FINE_PIXELS = 3_000, 16_000
# An object is taken for open when that explains the prompts this much better; it has more numbers. Up to 0.03
# for closed doors, drawers and sliding panels, from 0.08 for open ones.
OPEN_GAIN = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class PanelFit:
    """A panel and how far its extents are from the prompts' boxes, one `box_misfit` a view.

    `loss` counts distances to masks too, summed over the views.
    """

    panel: Panel
    misfits: tuple[float, ...]
    loss: float


def fit_panel(views: list[PromptedView], rng: np.random.Generator) -> PanelFit:
    """Find the panel and the object's box whose visible extents are those of the prompts.

    Args:
        views: Prompted images; at least one of each part.
        rng: For the search of the front's plane.

    Raises:
        ReconstructionError: A prompt shows no surface, or its part is no panel.

    Not checked: the panel is a rectangle, its edges level; the object is a box. Read `misfits`.
    """
    moving = [view for view in views if view.part == MOVING]
    centers = np.array([view.camera.center for view in moving])
    T_world_panel, size = panel_frame([_surface(view) for view in moving], centers, rng)
    coarse = [Crop.of(view, T_world_panel, COARSE_PIXELS) for view in views]
    fine = [Crop.of(view, T_world_panel, FINE_PIXELS) for view in views]
    fit = _closed(coarse, fine, ClosedShapes(T_world_panel=T_world_panel, size=size))
    if fit.loss <= OPEN_GAIN:
        return fit
    opened = _open(coarse, fine, T_world_panel)
    return opened if opened is not None and opened.loss < fit.loss - OPEN_GAIN else fit


def _closed(coarse: list[Crop], fine: list[Crop], shapes: ClosedShapes) -> PanelFit:
    search = Search(shapes=shapes)
    found = [search.descend(start, coarse, COARSE_STEPS) for start in first_shapes(coarse, shapes.size)]
    if not found:
        raise ReconstructionError(
            STAGE, "the boxes of the moving part show no common front", "draw them around the same part"
        )
    best = min(found, key=lambda item: item[1])[0]
    found = [search.descend(start, fine, FINE_STEPS) for start in with_seams(best, shapes.size)]
    return _fit(search, min(found, key=lambda item: item[1])[0], fine)


def _open(coarse: list[Crop], fine: list[Crop], T_world_panel: Array) -> PanelFit | None:
    size = panel_size(coarse)
    found = []
    for shapes, start in open_shapes(coarse, T_world_panel, size, first_shapes(coarse, size)):
        search = Search(shapes=shapes)
        found.append((search, *search.descend(start, coarse, COARSE_STEPS)))
    if not found:
        return None
    search, start, _ = min(found, key=lambda item: item[2])
    fit = _fit(search, search.descend(start, fine, FINE_STEPS)[0], fine)
    return replace(fit, panel=with_air(fit.panel, size))


def _fit(search: Search, shape: Array, crops: list[Crop]) -> PanelFit:
    shape = search.with_handles(shape, crops)
    compared = search.panel(shape)
    return PanelFit(
        panel=search.result(shape),
        misfits=tuple(crop.misfit(compared) for crop in crops),
        loss=sum(crop.loss(compared) for crop in crops),
    )


def _surface(view: PromptedView) -> Array:
    """Surface points (N, 3) inside a view's box, world frame."""
    x0, y0, x1, y1 = np.maximum(np.rint(view.box), 0).astype(int)
    points = view.points_world[y0:y1, x0:x1].reshape(-1, 3)
    return points[np.isfinite(points[:, 0])]
