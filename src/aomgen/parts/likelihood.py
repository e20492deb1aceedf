"""Log-likelihoods of the labels of every Gaussian, from prompts, masks and fitted boxes."""

from dataclasses import dataclass, replace
from typing import Annotated, Final, Self

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import ReconstructionError
from aomgen.parts.panel import Panel
from aomgen.parts.panel_fit import fit_panel
from aomgen.parts.panel_views import TrackedPoints, within
from aomgen.parts.prompted_images import PromptedImage, surface_seen
from aomgen.parts.scan_views import ScanView, lift
from aomgen.segmentation.interface import Mask

# Columns of log-likelihoods and posteriors.
LABELS: Final = np.array([BACKGROUND, STATIC, MOVING], np.uint8)
# Painted weight below which no view has really seen a Gaussian, [px].
MIN_WEIGHT = 0.02
# How often boxes are wrong about a Gaussian that they paint, and about one that no view shows.
PANEL_ERROR, UNSEEN_ERROR = 0.02, 0.15
# Probability that a mask in a box (row) is as it is if a Gaussian there is background, static or moving: seen
# inside the mask, in the box beside it, and outside the box. Masks are ragged and bleed; boxes are drawn by
# people. Segmenters find whole objects, so a mask of the static part does not speak against the moving one.
GIVEN_MASK: Final = {
    MOVING: np.array([[0.3, 0.3, 0.6], [0.3, 0.3, 0.2], [0.4, 0.4, 0.05]]),
    STATIC: np.array([[0.2, 0.6, 0.6], [0.4, 0.2, 0.4], [0.4, 0.05, 0.4]]),
}
# Fitted boxes further from those of the prompts than this, mean `box_misfit` (8 % of a box a side), explain
# nothing; right ones reach 0.07.
MAX_MISFIT = 0.3
# Where no boxes explain the prompts, what no mask shows is background: odds.
BACKGROUND_ODDS = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class PartEvidence:
    """Evidence for the labels of N Gaussians.

    Attributes:
        log_likelihoods: (N, 3), of background, static and moving part.
        method: What they come from, see `Parts`.
        panel: The fitted boxes of method "boxes".
    """

    log_likelihoods: Annotated[Array, "_ 3"]
    method: str
    panel: Panel | None = None

    __post_init__ = freeze_arrays

    def with_motion(self, log_odds: Array) -> Self:
        """The same and the log odds (N,) of moving over standing still."""
        return replace(self, log_likelihoods=self.log_likelihoods + log_odds[:, None] * (LABELS == MOVING))


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceView:
    """A scan view and the surface it shows: points (H, W, 3), world frame, NaN where there is none."""

    view: ScanView
    points_world: Array


def surface_views(gaussians: Gaussians, views: list[ScanView]) -> list[SurfaceView]:
    """The surface that each view shows, robot left out."""
    return [
        SurfaceView(view=view, points_world=surface_seen(gaussians, view.camera, view.robot))
        for view in views
    ]


def prompted_evidence(
    gaussians: Gaussians,
    prompted: list[PromptedImage],
    surfaces: list[SurfaceView],
    rng: np.random.Generator,
    motion_log_odds: Array | None,
) -> PartEvidence:
    """Evidence of boxes fitted to prompts, masks and motion; of prompts and masks alone where no boxes fit.

    Args:
        gaussians: World frame.
        prompted: Answers to the prompts.
        surfaces: Views in which fitted boxes are drawn.
        rng: For the panel's search.
        motion_log_odds: See `part_evidence`; shapes the boxes, and is not added here.
    """
    tracked = None if motion_log_odds is None else TrackedPoints.of(gaussians, motion_log_odds)
    try:
        fit = fit_panel([item.on_surface(gaussians) for item in prompted], rng, tracked)
    except ReconstructionError:
        fit = None
    if fit is None or not np.mean(fit.misfits) <= MAX_MISFIT:
        # The part is no panel: its masks are what is known of it.
        masks = sum((_of_prompt(gaussians, item) for item in prompted), np.zeros((len(gaussians), 3)))
        return PartEvidence(log_likelihoods=masks + np.log([BACKGROUND_ODDS, 1, 1]), method="masks")
    return panel_evidence(gaussians, fit.panel, surfaces)


def _of_prompt(gaussians: Gaussians, item: PromptedImage) -> Array:
    """Log-likelihoods (N, 3) by the mask and the box of one prompt; 0 for what the image does not show."""
    inside = within(item.box, item.view.robot.shape)
    mask = item.best_mask & inside
    shares, seen = _shares(gaussians, item.view, [mask, inside & ~mask, ~inside])
    return np.where(seen[:, None], np.log(np.maximum(shares @ GIVEN_MASK[item.part], 1e-3)), 0.0)


def panel_evidence(gaussians: Gaussians, panel: Panel, surfaces: list[SurfaceView]) -> PartEvidence:
    """Of what the boxes paint in many views, or of its place where no view shows a Gaussian."""
    weights = np.zeros((len(gaussians), 3))
    for item in surfaces:
        labels = panel.labels_seen(item.points_world, item.view.camera.center)
        masks = [(labels == value) & ~item.view.robot for value in LABELS]
        weights += lift(gaussians, item.view, masks)
    total = weights.sum(1, keepdims=True)
    column = np.searchsorted(LABELS, panel.labels(gaussians.means))
    by_place = np.eye(3)[column] * (1 - 3 * UNSEEN_ERROR) + UNSEEN_ERROR
    painted = weights / np.maximum(total, 1e-9) * (1 - 3 * PANEL_ERROR) + PANEL_ERROR
    log_likelihoods = np.log(np.where(total > MIN_WEIGHT, painted, by_place))
    return PartEvidence(log_likelihoods=log_likelihoods, method="boxes", panel=panel)


def _shares(gaussians: Gaussians, view: ScanView, masks: list[Mask]) -> tuple[Array, NDArray[np.bool_]]:
    """Shares (N, M) of each Gaussian's painted weight in masks of one view, robot left out; and who is seen."""
    weights = lift(gaussians, view, [mask & ~view.robot for mask in masks]).astype(np.float64)
    total = weights.sum(1)
    return weights / np.maximum(total, 1e-9)[:, None], total > MIN_WEIGHT
