"""Log-likelihoods of the labels of every Gaussian, from prompts, masks and fitted boxes."""

from dataclasses import dataclass, replace
from typing import Annotated, Final, Self

import numpy as np

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import ReconstructionError
from aomgen.parts.panel import Panel
from aomgen.parts.panel_fit import fit_panel
from aomgen.parts.panel_terms import TrackedPoints, pixels_within
from aomgen.parts.prompted_images import PromptedImage
from aomgen.parts.scan_views import ScanView, lift

# Columns of log-likelihoods and posteriors.
LABELS: Final = np.array([BACKGROUND, STATIC, MOVING], np.uint8)
# Blended weight of a Gaussian in a view below which the view does not show it, [px].
MIN_WEIGHT = 0.02
# Probability that boxes mislabel a Gaussian that is visible in views, and one that no view shows.
PANEL_ERROR, UNSEEN_ERROR = 0.02, 0.15
# Probability of the position of a Gaussian, for each part of the prompt: in the mask, in the box outside the mask, or outside the box
# (rows), if the Gaussian is background, static or moving (columns). Masks have errors at their borders, and boxes are drawn manually.
# Segmenters find whole objects, so a mask of the static part is no evidence against the moving one.
GIVEN_MASK: Final = {
    MOVING: np.array([[0.3, 0.3, 0.6], [0.3, 0.3, 0.2], [0.4, 0.4, 0.05]]),
    STATIC: np.array([[0.2, 0.6, 0.6], [0.4, 0.2, 0.4], [0.4, 0.05, 0.4]]),
}
# Largest mean `box_misfit` of valid fitted boxes to the prompts (8 % of a box at each side); correct ones reach 0.07.
MAX_MISFIT = 0.3
# Likelihood ratio of background to parts outside all masks, if no boxes fit the prompts.
BACKGROUND_RATIO = 1.5

# A scan view and its surface points (H, W, 3), world frame, NaN where there is no surface or the robot.
ViewSurface = tuple[ScanView, Array]


@dataclass(frozen=True, slots=True, kw_only=True)
class PartEvidence:
    """Evidence for the labels of N Gaussians.

    Attributes:
        log_likelihoods: (N, 3), of background, static and moving part.
        method: Source of the evidence, see `Parts`.
        panel: The fitted boxes of method "boxes".
    """

    log_likelihoods: Annotated[Array, "_ 3"]
    method: str
    panel: Panel | None = None

    __post_init__ = freeze_arrays

    def add_motion(self, log_ratios: Array) -> Self:
        """Add the log-likelihood ratios (N,) of moving to resting."""
        return replace(self, log_likelihoods=self.log_likelihoods + log_ratios[:, None] * (LABELS == MOVING))


def weigh_prompts(
    gaussians: Gaussians,
    prompted: list[PromptedImage],
    surfaces: list[ViewSurface],
    rng: np.random.Generator,
    motion_log_ratios: Array | None,
) -> PartEvidence:
    """Compute evidence from boxes fitted to prompts, masks and motion; from masks alone where no boxes fit.

    Args:
        gaussians: World frame.
        prompted: Segmented prompts.
        surfaces: Views in which fitted boxes are rendered.
        rng: Generator for the panel's search.
        motion_log_ratios: See `weigh_evidence`; used for the fit of the boxes only.
    """
    tracked = None if motion_log_ratios is None else TrackedPoints.of(gaussians, motion_log_ratios)
    try:
        panel, misfits = fit_panel([item.on_surface(gaussians) for item in prompted], rng, tracked)
    except ReconstructionError:
        panel, misfits = None, ()
    if panel is not None and np.mean(misfits) <= MAX_MISFIT:
        return weigh_panel(gaussians, panel, surfaces)
    # The part is no panel, so only its masks are used.
    masks = sum((_weigh_mask(gaussians, item) for item in prompted), np.zeros((len(gaussians), 3)))
    return PartEvidence(log_likelihoods=masks + np.log([BACKGROUND_RATIO, 1, 1]), method="masks")


def _weigh_mask(gaussians: Gaussians, item: PromptedImage) -> Array:
    """Compute log-likelihoods (N, 3) of the mask and the box of one prompt; 0 for Gaussians that the image does not show."""
    inside = pixels_within(item.box, item.view.robot.shape)
    mask = item.best_mask & inside
    regions = [region & ~item.view.robot for region in (mask, inside & ~mask, ~inside)]
    weights = lift(gaussians, item.view, regions).astype(np.float64)
    total = weights.sum(1, keepdims=True)
    likelihoods = weights / np.maximum(total, 1e-9) @ GIVEN_MASK[item.part]
    return np.where(total > MIN_WEIGHT, np.log(np.maximum(likelihoods, 1e-3)), 0.0)


def weigh_panel(gaussians: Gaussians, panel: Panel, surfaces: list[ViewSurface]) -> PartEvidence:
    """Compute evidence from the boxes rendered in many views; from positions for Gaussians that no view shows."""
    weights = np.zeros((len(gaussians), 3))
    for view, points_world in surfaces:
        labels = panel.labels_seen(points_world, view.camera.center)
        weights += lift(gaussians, view, [(labels == value) & ~view.robot for value in LABELS])
    total = weights.sum(1, keepdims=True)
    inside = np.eye(3)[np.searchsorted(LABELS, panel.labels(gaussians.means))]
    unseen = inside * (1 - 3 * UNSEEN_ERROR) + UNSEEN_ERROR
    seen = weights / np.maximum(total, 1e-9) * (1 - 3 * PANEL_ERROR) + PANEL_ERROR
    log_likelihoods = np.log(np.where(total > MIN_WEIGHT, seen, unseen))
    return PartEvidence(log_likelihoods=log_likelihoods, method="boxes", panel=panel)
