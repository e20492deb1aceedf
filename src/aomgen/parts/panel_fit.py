"""Search for the two boxes (see `panel`) that explain prompts, masks, video and gripper.

A box that is drawn around a part touches it on all four sides, in every prompted image. This is stronger evidence than a single
mask. Further evidence are masks that fill their box, and points for which the demonstration shows whether they move. Open and
closed objects have the same model: an upright body, and a panel of any orientation.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from aomgen.conventions import MOVING, STATIC
from aomgen.core.boxes import QUANTILES, find_upright_axes
from aomgen.core.transforms import apply, invert, transform
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.parts.panel import STAGE, UNKNOWNS, YAW, Panel, find_panel_frame
from aomgen.parts.panel_terms import (
    MAX_MASK_MISFIT,
    Crop,
    PromptedView,
    TrackedPoints,
    box_misfit,
    pixels_within,
)

COARSE_PIXELS, FINE_PIXELS = 3_000, 32_000
# Steps of the search, as shares of the panel's diagonal: coarse ones on fewer pixels, then fine ones on all pixels,
# down to a few millimeters on a door.
COARSE_STEPS, FINE_STEPS = (0.2, 0.1, 0.05, 0.025), (0.025, 0.012, 0.006, 0.003)
# After each coarse step the worse half of the starts is dropped; this number of the best is refined on all pixels.
REFINED = 2
# Number of rounds over all unknowns at one step size; another one seldom reduces the loss.
MAX_ROUNDS = 4
# Largest number of steps in one direction; distant starts (a wall behind the object) need many.
MAX_STRIDES = 50
# Least reduction of the loss by a step: a tenth of a pixel of a box of 200 px.
MIN_GAIN = 1e-4
# Thickness of the body's faces, in which their Gaussians are distributed, as a share of the panel's diagonal. Half of it is used to
# compare boxes, whose sides are those of the faces. The lower side has none, because it is on the support.
SKIN_SHARE = 0.02
# Regularization weight of the extent of both boxes, per diagonal, in units of the loss (see `Crop.loss`; 1 is an error of a whole
# box width): the edges then are at the outermost points, not beyond them.
SIZE_WEIGHT = 0.03
# Regularization weight of the panel outside the body's footprint, per diagonal: most objects are scanned closed, and a side without
# a prompt ends at the panel. The masks of open doors have more weight.
UNCOVERED_WEIGHT = 0.15
# Regularization weight of the angle between body and panel, per radian, and the limit of this term: closed and ajar parts are
# parallel to their body, open doors have any angle.
SKEW_WEIGHT, MAX_SKEW_LOSS = 0.5, 0.1
# Initial seams behind the panel, as shares of its diagonal: a thick door, a thin lid.
SEAM_SHARES = (0.05, 0.015)
# Initial reach of handles, as a share of the panel's diagonal.
REACH_SHARE = 0.1
# Largest distance to the front plane of points on the panel, as a share of the panel's diagonal, and least number of them.
FRONT_SHARE, MIN_FRONT_PIXELS = 0.05, 20
# Least cosine between normals (2 degrees) and largest distance, as a share of the panel's diagonal, of two equal planes.
SAME_PLANE_COS, SAME_PLANE_SHARE = 0.9994, 0.02
# Quantiles of the points that bound the initial panel.
EDGE_QUANTILES = (0.03, 0.97)


class Term(Protocol):
    """One loss term of the boxes."""

    def loss(self, panel: Panel) -> float:
        """Compute the loss of the boxes, at least 0."""
        ...


def fit_panel(
    views: Sequence[PromptedView], rng: np.random.Generator, tracked: TrackedPoints | None = None
) -> tuple[Panel, tuple[float, ...]]:
    """Find the two boxes.

    Args:
        views: Prompted images; at least one of each part.
        rng: Generator for the search of the front's plane.
        tracked: Points for which the demonstration shows whether they move.

    Returns:
        The boxes, and the distance of their extents from each prompt, see `box_misfit`.

    Raises:
        ReconstructionError: A prompt shows no surface, or its part is no panel.

    Not checked: the panel is a rectangle with level edges; the body is a box. The misfits indicate violations.
    """
    panels = []
    for T_world_panel, size in _find_frames([view for view in views if view.part == MOVING], rng):
        coarse, fine = (
            [Crop.of(view, T_world_panel, pixels) for view in views]
            for pixels in (COARSE_PIXELS, FINE_PIXELS)
        )
        points: list[Term] = [] if tracked is None else [tracked.near(T_world_panel, size)]
        starts = _find_starts(coarse, T_world_panel, size)
        panels += [(start, size, [*coarse, *points], fine, points) for start in starts]
    if not panels:
        raise ReconstructionError(
            STAGE, "the boxes of the moving part show no common front", "draw them around the same part"
        )
    for share in COARSE_STEPS:
        found = []
        for start, size, terms, fine, points in panels:
            panel, loss = descend(start, size, terms, (share,))
            found.append((loss, (panel, size, terms, fine, points)))
        found.sort(key=lambda item: item[0])
        panels = [item for _, item in found[: max(REFINED, len(found) // 2)]]
    refined = []
    for start, size, _, fine, points in panels:
        panel, loss = descend(start, size, [*fine, *points], FINE_STEPS)
        refined.append((loss, panel, size, fine))
    _, panel, size, fine = min(refined, key=lambda item: item[0])
    compared = panel.thicken_body(0.5 * SKIN_SHARE * size)
    return panel.thicken_body(SKIN_SHARE * size), tuple(crop.misfit(compared) for crop in fine)


def descend(panel: Panel, size: float, terms: Sequence[Term], shares: Sequence[float]) -> tuple[Panel, float]:
    """Search along all directions with decreasing steps.

    Args:
        panel: Start.
        size: Diagonal of the panel, [m].
        terms: Terms of the objective.
        shares: Steps, as shares of the diagonal.

    Returns:
        The best panel and its loss.
    """
    best, directions = compute_loss(panel, size, terms), _list_directions(panel, size)
    for share in shares:
        for _ in range(MAX_ROUNDS):
            before = best
            for step in share * size * directions:
                for _ in range(MAX_STRIDES):
                    moved = panel.move(step)
                    loss = compute_loss(moved, size, terms, limit=best - MIN_GAIN)
                    if not loss < best - MIN_GAIN:
                        break
                    panel, best = moved, loss
            if not best < before:
                break
    return panel, best


def compute_loss(panel: Panel, size: float, terms: Sequence[Term], limit: float = np.inf) -> float:
    """Add all terms and the regularization; infinite for impossible boxes, and if the sum reaches the limit."""
    if not panel.is_valid:
        return np.inf
    thick = panel.thicken_body(0.5 * SKIN_SHARE * size)
    shape = (SIZE_WEIGHT * panel.extent_m + UNCOVERED_WEIGHT * thick.uncovered_m) / size
    skew = min(SKEW_WEIGHT * panel.skew_rad, MAX_SKEW_LOSS)
    total = 0.0
    for term in terms:
        total += term.loss(thick)
        # No term is negative: the remaining ones, which cost most of the time, cannot bring the sum below the limit.
        if not total + shape + skew < limit:
            return np.inf
    return total + shape + skew


def _list_directions(panel: Panel, size: float) -> Array:
    """List directions (M, 13) of steps: each unknown alone, and edges of both boxes together."""
    alone = np.eye(UNKNOWNS)
    alone[YAW] /= size
    # The panel's second axis is the body's third when it is upright, its second when it is level.
    second = 2 if abs(panel.T_panel_body[1, 2]) > np.sqrt(0.5) else 1
    pairs = [(0, 6), (1, 9), (2, 6 + second), (3, 9 + second)]
    both = [alone[edge] + alone[face] for edge, face in pairs]
    return np.array([sign * direction for direction in (*alone, *both) for sign in (1.0, -1.0)])


def _find_frames(moving: Sequence[PromptedView], rng: np.random.Generator) -> list[tuple[Array, float]]:
    """Find frames on the front plane and diagonals: of the boxes, and of the masks where that is another plane."""
    centers = np.array([view.camera.center for view in moving])
    boxed, masked = (
        find_panel_frame([_select_surface(view, masked=masked) for view in moving], centers, rng)
        for masked in (False, True)
    )
    normals = boxed[0][:3, 2], masked[0][:3, 2]
    apart = abs(float((masked[0][:3, 3] - boxed[0][:3, 3]) @ normals[0]))
    same = normals[0] @ normals[1] > SAME_PLANE_COS and apart < SAME_PLANE_SHARE * boxed[1]
    return [boxed] if same else [boxed, masked]


def _find_starts(crops: list[Crop], T_world_panel: Array, size: float) -> list[Panel]:
    """List initial boxes: the body along the panel or along its masks, and the edges from masks or from boxes alone."""
    shown = [apply(T_world_panel, crop.surface(masked=True)) for crop in crops]
    body = np.concatenate([points for points, crop in zip(shown, crops, strict=True) if crop.part == STATIC])
    along = T_world_panel[:2, 0] / np.linalg.norm(T_world_panel[:2, 0])
    square = np.stack([along, [-along[1], along[0]]], 1)
    panels = [corners for masked in (True, False) for corners in _find_edges(crops, size, masked=masked)]
    starts = []
    for axes, points in ((square, np.concatenate(shown)), (find_upright_axes(body)[:2, :2], body)):
        R = np.eye(3)
        R[:2, :2] = axes
        T_world_body = transform(R, np.median(points, 0))
        T_panel_body = invert(T_world_panel) @ T_world_body
        body_low, body_high = np.quantile(apply(invert(T_world_body), points), QUANTILES, axis=0)
        starts += [
            Panel(
                T_world_panel=T_world_panel, low=low, high=high,
                T_panel_body=T_panel_body, body_low=body_low, body_high=body_high,
            )
            for low, high in panels
        ]  # fmt: skip
    return starts


def _find_edges(crops: list[Crop], size: float, *, masked: bool) -> list[tuple[Array, Array]]:
    """Find initial corners of the panel: the union of the masks, or the intersection of the boxes."""
    spans = []
    for crop in crops:
        if crop.part == MOVING:
            points = crop.surface(masked=masked)
            points = points[np.abs(points[:, 2]) < FRONT_SHARE * size]
            if len(points) < MIN_FRONT_PIXELS:
                return []
            spans.append(np.quantile(points[:, :2], EDGE_QUANTILES, axis=0))
    lows, highs = np.moveaxis(np.array(spans), 1, 0)
    low, high = (lows.min(0), highs.max(0)) if masked else (lows.max(0), highs.min(0))
    if not (low < high).all():
        return []
    return [(np.append(low, -seam * size), np.append(high, REACH_SHARE * size)) for seam in SEAM_SHARES]


def _select_surface(view: PromptedView, *, masked: bool) -> Array:
    """Select surface points (N, 3) inside a view's box and optionally inside the mask that fits it best; world frame."""
    shown = pixels_within(view.box, view.points_world.shape[:2])
    mask = min(view.masks, key=lambda mask: box_misfit(mask, view.box), default=None)
    if masked and mask is not None and box_misfit(mask, view.box) < MAX_MASK_MISFIT:
        shown &= mask
    points = view.points_world[shown]
    return points[np.isfinite(points[:, 0])]
