"""Log-likelihoods of the labels of every Gaussian, from prompts, masks and fitted boxes, and their smooth posterior."""

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array, freeze
from aomgen.errors import ReconstructionError
from aomgen.parts.panel import Panel, TrackedPoints
from aomgen.parts.panel_fit import fit_panel
from aomgen.parts.prompted_images import PromptedImage, ScanView, lift, surface_seen, within

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
# Fitted boxes further from those of the prompts than this, mean `box_misfit` (6 % of a box a side), explain
# nothing; right ones reach 0.07.
MAX_MISFIT = 0.25
# Where no boxes explain the prompts, what no mask shows is background: odds.
BACKGROUND_ODDS = 1.5
# Neighbours of a Gaussian in the graph: those around it on a surface.
NEIGHBORS = 10
# Coupling of two touching neighbors of one color, log odds; and the share of it that is left across an edge
# in color.
COUPLING, ACROSS_EDGE = 0.6, 0.2
# Distance over which points are one surface, [m]; and over which colors are one, of 0..1.
REACH_M, COLOR_SD = 0.01, 0.08
# Mean-field iterations: labels can spread over as many neighbourhoods.
ITERATIONS = 30

# A scan view and the surface it shows: points (H, W, 3), world frame, NaN where there is none.
SurfaceView = tuple[ScanView, Array]


@dataclass(frozen=True, slots=True, kw_only=True)
class PartEvidence:
    """Evidence for the labels of N Gaussians.

    Attributes:
        log_likelihoods: (N, 3), of background, static and moving part.
        method: What they come from, see `Parts`.
        panel: The fitted boxes of method "boxes".
    """

    log_likelihoods: Array
    method: str
    panel: Panel | None = None

    def __post_init__(self) -> None:
        freeze(self, "log_likelihoods", self.log_likelihoods, (None, 3))

    def with_motion(self, log_odds: Array) -> Self:
        """The same and the log odds (N,) of moving over standing still."""
        return replace(self, log_likelihoods=self.log_likelihoods + log_odds[:, None] * (LABELS == MOVING))


def surface_views(gaussians: Gaussians, views: list[ScanView]) -> list[SurfaceView]:
    """The surface that each view shows, robot left out."""
    return [(view, surface_seen(gaussians, view.camera, view.robot)) for view in views]


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
        panel, misfit = fit_panel([item.on_surface(gaussians) for item in prompted], rng, tracked)
        if misfit <= MAX_MISFIT:
            return panel_evidence(gaussians, panel, surfaces)
    except ReconstructionError:
        # The part is no panel: its masks are what is known of it.
        pass
    masks = sum((_prompt_evidence(gaussians, item) for item in prompted), np.zeros((len(gaussians), 3)))
    return PartEvidence(log_likelihoods=masks + np.log([BACKGROUND_ODDS, 1, 1]), method="masks")


def _prompt_evidence(gaussians: Gaussians, item: PromptedImage) -> Array:
    """Log-likelihoods (N, 3) by the mask and the box of one prompt; 0 for what the image does not show."""
    inside = within(item.box, item.view.robot.shape)
    mask = item.best_mask & inside
    areas = [area & ~item.view.robot for area in (mask, inside & ~mask, ~inside)]
    weights = lift(gaussians, item.view, areas).astype(np.float64)
    total = weights.sum(1, keepdims=True)
    shares = weights / np.maximum(total, 1e-9)
    return np.where(total > MIN_WEIGHT, np.log(np.maximum(shares @ GIVEN_MASK[item.part], 1e-3)), 0.0)


def panel_evidence(gaussians: Gaussians, panel: Panel, surfaces: list[SurfaceView]) -> PartEvidence:
    """Of what the boxes paint in many views, or of its place where no view shows a Gaussian."""
    weights = np.zeros((len(gaussians), 3))
    for view, points_world in surfaces:
        labels = panel.labels_seen(points_world, view.camera.center)
        weights += lift(gaussians, view, [(labels == value) & ~view.robot for value in LABELS])
    total = weights.sum(1, keepdims=True)
    column = np.searchsorted(LABELS, panel.labels(gaussians.means.astype(np.float64)))
    by_place = np.eye(3)[column] * (1 - 3 * UNSEEN_ERROR) + UNSEEN_ERROR
    painted = weights / np.maximum(total, 1e-9) * (1 - 3 * PANEL_ERROR) + PANEL_ERROR
    log_likelihoods = np.log(np.where(total > MIN_WEIGHT, painted, by_place))
    return PartEvidence(log_likelihoods=log_likelihoods, method="boxes", panel=panel)


def smooth_posterior(points: ArrayLike, colors: ArrayLike, log_likelihoods: Array) -> Array:
    """Probability (N, L) of each label at each point.

    A conditional random field over nearest neighbors: neighbors of one color tend to be of one part.

    Args:
        points: (N, 3), [m].
        colors: (N, 3), 0..1.
        log_likelihoods: (N, L), of all evidence about a point alone.

    Source: mean-field iterations of Kraehenbuehl and Koltun, "Efficient Inference in Fully Connected CRFs",
    2011, with sparse neighbors.
    """
    coupling = _coupling(np.asarray(points, np.float64), np.asarray(colors, np.float64))
    posterior = _normalize(log_likelihoods)
    for _ in range(ITERATIONS):
        posterior = _normalize(log_likelihoods + coupling @ posterior)
    return posterior


def _coupling(points: Array, colors: Array) -> csr_matrix:
    count = min(NEIGHBORS, len(points) - 1)
    if count < 1:
        return csr_matrix((len(points), len(points)))
    distances, nearest = cKDTree(points).query(points, k=count + 1)
    distances, nearest = distances[:, 1:], nearest[:, 1:]
    contrast = np.linalg.norm(colors[:, None] - colors[nearest], axis=2)
    alike = ACROSS_EDGE + (1 - ACROSS_EDGE) * np.exp(-0.5 * (contrast / COLOR_SD) ** 2)
    weights = COUPLING * alike * np.exp(-0.5 * (distances / REACH_M) ** 2)
    rows = np.repeat(np.arange(len(points)), count)
    one_way = csr_matrix((weights.ravel(), (rows, nearest.ravel())), shape=(len(points), len(points)))
    return csr_matrix((one_way + one_way.T) / 2)


def _normalize(log_weights: Array) -> Array:
    weights = np.exp(log_weights - log_weights.max(1, keepdims=True))
    return np.asarray(weights / weights.sum(1, keepdims=True), np.float64)
