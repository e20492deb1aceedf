"""Finding the two boxes (see `panel`) that explain all evidence: prompts, masks, video and gripper.

A box drawn around a part touches it on all four sides, in every prompted image at once: that is
stronger evidence than any single mask. Masks that fill their box count beside it, and points of which
the demonstration shows whether they move. Open and closed objects are one model: a body that stands
upright, and a panel that lies, leans or stands anywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from aomgen.conventions import MOVING, STATIC
from aomgen.core.boxes import QUANTILES, find_upright_axes
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.parts.panel import STAGE, Panel, panel_frame
from aomgen.parts.panel_views import MAX_MASK_MISFIT, Crop, PromptedView, TrackedPoints, box_misfit, within

COARSE_PIXELS, FINE_PIXELS = 3_000, 16_000
# Steps of the search, as shares of the panel's diagonal: coarse ones on fewer pixels.
COARSE_STEPS = (0.2, 0.1, 0.05, 0.025)
# Fine steps on all pixels, same share: down to a few millimetres on a door.
FINE_STEPS = (0.025, 0.012, 0.006, 0.003)
# So many of the best coarse answers are refined.
REFINED = 2
# Rounds over all numbers at one step size; a further one seldom finds more.
MAX_ROUNDS = 4
# Most steps in one direction at once: far starts (a wall behind the object) are walked back so.
MAX_STRIDES = 50
# The loss has to fall by this much: a tenth of a pixel of a box 200 px wide.
MIN_GAIN = 1e-4
# Thickness of the body's faces, in which their Gaussians scatter, as share of the panel's diagonal; half of
# it while boxes are compared, which show where the face itself is. Nothing below: there is the table.
SKIN_SHARE = 0.02
# Prices in units of the loss (see `Crop.loss`; 1 = a box off by all its width). Of all edges together, per
# diagonal: edges lie on the outermost points and not in the air beyond.
SIZE_PRICE = 0.03
# Of panel outside the body's footprint, per diagonal: most objects are scanned closed, and a side that no
# prompt shows is where the panel ends. Doors that stand open gain more than this by their masks.
UNCOVERED_PRICE = 0.15
# Of a body that is not square to its panel, per radian, and at most: closed and ajar ones are, open doors stand at
# any angle.
YAW_PRICE, MAX_YAW_PRICE = 0.5, 0.1
# First seams behind the panel, as shares of its diagonal: a thick door, a thin lid.
SEAM_SHARES = (0.05, 0.015)
# First reach of handles, as share of the panel's diagonal.
REACH_SHARE = 0.1
# Points this close to the front plane, as share of the panel's diagonal, are the panel's; and fewest of them.
FRONT_SHARE, MIN_FRONT_PIXELS = 0.05, 20
# Planes this parallel (2 degrees) and close, as share of the panel's diagonal, are one.
SAME_PLANE_COS, SAME_PLANE_SHARE = 0.9994, 0.02
# What a panel's first edges lie between, quantiles.
EDGE_QUANTILES = (0.03, 0.97)

# The numbers of a shape: edges left, right, lower and upper of the panel; its seam and reach; low and high
# corner of the body; the body's turn about the vertical.
SEAM, REACH, BODY_LOW, BODY_HIGH, YAW, NUMBERS = 4, 5, slice(6, 9), slice(9, 12), 12, 13


class Term(Protocol):
    """One loss term of the boxes."""

    def loss(self, panel: Panel) -> float:
        """Loss of the boxes, 0 at best."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PanelFit:
    """The boxes, how far their extents are from the prompts' (one `box_misfit` a view), and the sum of losses."""

    panel: Panel
    misfits: tuple[float, ...]
    loss: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Shapes:
    """What the numbers of a shape (13,) mean: edges are in meters, the yaw in radians.

    Attributes:
        T_world_panel: Panel frame (4, 4).
        T_panel_body: Body frame (4, 4) before its turn.
        size: Diagonal of the panel, [m].
    """

    T_world_panel: Array
    T_panel_body: Array
    size: float

    def panel(self, shape: Array, skin_share: float) -> Panel:
        """The boxes, the body's outer faces thickened by a share of the panel's diagonal."""
        skin = skin_share * self.size
        turn = transform(matrix_from_rotvec([0, 0, shape[YAW]]), np.zeros(3))
        return Panel(
            T_world_panel=self.T_world_panel,
            low=shape[[0, 2, SEAM]],
            high=shape[[1, 3, REACH]],
            T_panel_body=self.T_panel_body @ turn,
            body_low=shape[BODY_LOW] - [skin, skin, 0],
            body_high=shape[BODY_HIGH] + skin,
        )

    def loss(self, shape: Array, terms: Sequence[Term]) -> float:
        """Of all terms, and prices; infinite where a shape is impossible."""
        sizes = np.append(shape[[1, 3]] - shape[[0, 2]], shape[BODY_HIGH] - shape[BODY_LOW])
        if not ((sizes > 0).all() and shape[SEAM] < 0 < shape[REACH]):
            return np.inf
        panel = self.panel(shape, 0.5 * SKIN_SHARE)
        extent = sizes.sum() - shape[SEAM]
        price = (SIZE_PRICE * extent + UNCOVERED_PRICE * panel.uncovered_m) / self.size
        askew = abs((self.yaw + shape[YAW] + np.pi / 4) % (np.pi / 2) - np.pi / 4)
        price += min(YAW_PRICE * askew, MAX_YAW_PRICE)
        return sum(term.loss(panel) for term in terms) + float(price)

    @property
    def yaw(self) -> float:
        """Direction of the body's first axis before its turn, from the panel's, about the vertical, [rad]."""
        R_world_body = self.T_world_panel[:3, :3] @ self.T_panel_body[:3, :3]
        along, body = self.T_world_panel[:2, 0], R_world_body[:2, 0]
        return float(np.arctan2(along[0] * body[1] - along[1] * body[0], along @ body))

    def trials(self) -> Array:
        """Directions (M, 13) of steps: each number alone, and edges of both boxes together."""
        alone = np.eye(NUMBERS)
        alone[YAW] /= self.size
        # The panel's second axis is the body's third when it stands, its second when it lies.
        second = 2 if abs(self.T_panel_body[1, 2]) > np.sqrt(0.5) else 1
        pairs = [(0, 6), (1, 9), (2, 6 + second), (3, 9 + second)]
        both = [alone[edge] + alone[face] for edge, face in pairs]
        signed = [sign * trial for trial in (*alone, *both) for sign in (1.0, -1.0)]
        return np.array(signed)

    def descend(self, shape: Array, terms: Sequence[Term], steps: tuple[float, ...]) -> tuple[Array, float]:
        """The best shape that steps lead to, each a share of the panel's diagonal, and its loss."""
        best, trials = self.loss(shape, terms), self.trials()
        for step in steps:
            for _ in range(MAX_ROUNDS):
                before = best
                for trial in step * self.size * trials:
                    for _ in range(MAX_STRIDES):
                        moved = shape + trial
                        loss = self.loss(moved, terms)
                        if not loss < best - MIN_GAIN:
                            break
                        shape, best = moved, loss
                if not best < before:
                    break
        return shape, best


def fit_panel(
    views: Sequence[PromptedView], rng: np.random.Generator, tracked: TrackedPoints | None = None
) -> PanelFit:
    """Find the two boxes.

    Args:
        views: Prompted images; at least one of each part.
        rng: For the search of the front's plane.
        tracked: Points of which the demonstration shows whether they move.

    Raises:
        ReconstructionError: A prompt shows no surface, or its part is no panel.

    Not checked: the panel is a rectangle, its edges level; the body is a box. Read `misfits`.
    """
    found = []
    for T_world_panel, size in _frames([view for view in views if view.part == MOVING], rng):
        coarse, fine = (
            [Crop.of(view, T_world_panel, pixels) for view in views]
            for pixels in (COARSE_PIXELS, FINE_PIXELS)
        )
        points: list[Term] = [] if tracked is None else [tracked.near(T_world_panel, size)]
        for shapes, start in _starts(coarse, T_world_panel, size):
            shape, loss = shapes.descend(start, [*coarse, *points], COARSE_STEPS)
            found.append((loss, shapes, shape, fine, points))
    if not found:
        raise ReconstructionError(
            STAGE, "the boxes of the moving part show no common front", "draw them around the same part"
        )
    refined = []
    for _, shapes, shape, fine, points in sorted(found, key=lambda item: item[0])[:REFINED]:
        shape, loss = shapes.descend(shape, [*fine, *points], FINE_STEPS)
        refined.append((loss, shapes, shape, fine))
    loss, shapes, shape, fine = min(refined, key=lambda item: item[0])
    compared = shapes.panel(shape, 0.5 * SKIN_SHARE)
    return PanelFit(
        panel=shapes.panel(shape, SKIN_SHARE),
        misfits=tuple(crop.misfit(compared) for crop in fine),
        loss=loss,
    )


def _frames(moving: Sequence[PromptedView], rng: np.random.Generator) -> list[tuple[Array, float]]:
    """Frames on the front plane and diagonals: of what boxes show, and of masks where that is another plane."""
    centers = np.array([view.camera.center for view in moving])
    boxed, masked = (
        panel_frame([_surface(view, masked=masked) for view in moving], centers, rng)
        for masked in (False, True)
    )
    normals = boxed[0][:3, 2], masked[0][:3, 2]
    apart = abs(float((masked[0][:3, 3] - boxed[0][:3, 3]) @ normals[0]))
    same = normals[0] @ normals[1] > SAME_PLANE_COS and apart < SAME_PLANE_SHARE * boxed[1]
    return [boxed] if same else [boxed, masked]


def _starts(crops: list[Crop], T_world_panel: Array, size: float) -> list[tuple[Shapes, Array]]:
    """First shapes: the body along the panel or level with its masks, edges from masks or from boxes alone."""
    shown = [apply(T_world_panel, crop.inside(masked=True)) for crop in crops]
    body = np.concatenate([points for points, crop in zip(shown, crops, strict=True) if crop.part == STATIC])
    along = T_world_panel[:2, 0] / np.linalg.norm(T_world_panel[:2, 0])
    square = np.stack([along, [-along[1], along[0]]], 1)
    panels = [edges for masked in (True, False) for edges in _edges(crops, size, masked=masked)]
    starts = []
    for axes, points in ((square, np.concatenate(shown)), (find_upright_axes(body)[:2, :2], body)):
        R = np.eye(3)
        R[:2, :2] = axes
        T_world_body = transform(R, np.median(points, 0))
        T_panel_body = invert(T_world_panel) @ T_world_body
        corners = np.quantile(apply(invert(T_world_body), points), QUANTILES, axis=0)
        shapes = Shapes(T_world_panel=T_world_panel, T_panel_body=T_panel_body, size=size)
        starts += [(shapes, np.array([*edges, *corners.ravel(), 0.0])) for edges in panels]
    return starts


def _edges(crops: list[Crop], size: float, *, masked: bool) -> list[Array]:
    """First edges, seam and reach (6,), from what masks show together or boxes have in common."""
    spans = []
    for crop in crops:
        if crop.part == MOVING:
            points = crop.inside(masked=masked)
            points = points[np.abs(points[:, 2]) < FRONT_SHARE * size]
            if len(points) < MIN_FRONT_PIXELS:
                return []
            spans.append(np.quantile(points[:, :2], EDGE_QUANTILES, axis=0))
    lows, highs = np.moveaxis(np.array(spans), 1, 0)
    low, high = (lows.min(0), highs.max(0)) if masked else (lows.max(0), highs.min(0))
    if not (low < high).all():
        return []
    return [
        np.array([low[0], high[0], low[1], high[1], -seam * size, REACH_SHARE * size]) for seam in SEAM_SHARES
    ]


def _surface(view: PromptedView, *, masked: bool) -> Array:
    """Surface points (N, 3) inside a view's box, also inside the mask that fills it best; world frame."""
    shown = within(view.box, view.points_world.shape[:2])
    mask = min(view.masks, key=lambda mask: box_misfit(mask, view.box), default=None)
    if masked and mask is not None and box_misfit(mask, view.box) < MAX_MASK_MISFIT:
        shown &= mask
    points = view.points_world[shown]
    return points[np.isfinite(points[:, 0])]
