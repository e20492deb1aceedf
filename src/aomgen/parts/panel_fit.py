"""Finding the two boxes (see `panel`) that explain all evidence: prompts, masks, video and gripper.

A box drawn around a part touches it on all four sides, in every prompted image at once: that is
stronger evidence than any single mask. Masks that fill their box count beside it, and points of which
the demonstration shows whether they move. Open and closed objects are one model: a body that stands
upright, and a panel that lies, leans or stands anywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aomgen.conventions import MOVING
from aomgen.core.boxes import QUANTILES, OrientedBox, find_upright_axes, upright_axes
from aomgen.core.planes import Plane, find_plane
from aomgen.core.transforms import apply, invert, transform
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.parts.panel import MAX_MASK_MISFIT, Crop, Panel, Term, TrackedPoints
from aomgen.parts.prompted_images import PromptedView, box_misfit, within

STAGE = "parts"
# Pixels of a prompted view that a coarse and a fine search look at.
COARSE_PIXELS, FINE_PIXELS = 3_000, 16_000
# Steps of the search, as shares of the panel's diagonal: down to a few millimetres on a door.
STEPS = tuple(0.2 * 0.5**k for k in range(7))
# So many of them are taken on few pixels, and so many of the best answers are refined.
COARSE, REFINED = 4, 2
# The loss has to fall by this much: a tenth of a pixel of a box 200 px wide.
MIN_GAIN = 1e-4
# Thickness of the body's faces, in which their Gaussians scatter, as share of the panel's diagonal; half of
# it while boxes are compared, which show where the face itself is. Nothing below: there is the table.
SKIN_SHARE = 0.02
# Prices in units of the loss (1 = a box off by all its width). Of all edges together, per diagonal: edges lie on
# the outermost points and not in the air beyond. Of panel outside the body's footprint, per diagonal: most objects
# are scanned closed, and a side that no prompt shows is where the panel ends; doors that stand open gain more by
# their masks. Of a body that is not square to its panel, per radian, and at most: open doors stand at any angle.
SIZE_PRICE, UNCOVERED_PRICE, YAW_PRICE, MAX_YAW_PRICE = 0.03, 0.15, 0.5, 0.1
# First seams behind the panel, a thick door and a thin lid, and first reach of handles, as shares of its diagonal.
SEAM_SHARES, REACH_SHARE = (0.05, 0.015), 0.1
# Points this close to the front, as share of the panel's diagonal, are the panel's; fewest of them; and the
# quantiles of them that its first edges lie between.
FRONT_SHARE, MIN_FRONT_PIXELS, EDGE_QUANTILES = 0.05, 20, (0.03, 0.97)
# Planes this parallel (2 degrees) and close, as share of the panel's diagonal, are one.
SAME_PLANE_COS, SAME_PLANE_SHARE = 0.9994, 0.02
# Surfaces scatter about their plane by this share of the part's diagonal; a part that shows fewer pixels has none.
SCATTER_SHARE, MIN_PIXELS = 0.015, 50
# Fronts this close to level or upright are so: objects stand on something. Lids that stand ajar lean more. [deg]
SNAP_DEG = 4.0

# The numbers of a shape: edges left, right, lower and upper of the panel; its seam and reach; low and high
# corner of the body; the body's turn about the vertical.
SEAM, REACH, BODY_LOW, BODY_HIGH, YAW, NUMBERS = 4, 5, slice(6, 9), slice(9, 12), 12, 13


@dataclass(frozen=True, slots=True, kw_only=True)
class Shapes:
    """What the numbers of a shape (13,) mean: edges are in meters, the yaw in radians.

    Attributes:
        T_world_panel: Panel frame (4, 4).
        T_world_body: Body frame (4, 4) before its turn.
        size: Diagonal of the panel, [m].
    """

    T_world_panel: Array
    T_world_body: Array
    size: float

    def panel(self, shape: Array, skin_share: float) -> Panel:
        """The boxes, the body's outer faces thickened by a share of the panel's diagonal."""
        skin = skin_share * self.size
        low, high = shape[[0, 2, SEAM]], shape[[1, 3, REACH]]
        body_low, body_high = shape[BODY_LOW] - [skin, skin, 0], shape[BODY_HIGH] + skin
        T_world_body = self.T_world_body @ transform(upright_axes(shape[YAW]), np.zeros(3))
        return Panel(
            moving=_box(self.T_world_panel, low, high),
            body=_box(T_world_body, body_low, body_high),
            front_m=-0.5 * float(low[2] + high[2]),
        )

    def loss(self, shape: Array, terms: Sequence[Term]) -> float:
        """Of all terms, and prices; infinite where a shape is impossible."""
        sizes = np.append(shape[[1, 3]] - shape[[0, 2]], shape[BODY_HIGH] - shape[BODY_LOW])
        if not ((sizes > 0).all() and shape[SEAM] < 0 < shape[REACH]):
            return np.inf
        panel = self.panel(shape, 0.5 * SKIN_SHARE)
        extent = sizes.sum() - shape[SEAM]
        price = (SIZE_PRICE * extent + UNCOVERED_PRICE * panel.uncovered_m) / self.size
        along, body = self.T_world_panel[:2, 0], panel.body.T_world_box[:2, 0]
        turn = np.arctan2(along[0] * body[1] - along[1] * body[0], along @ body)
        askew = abs((turn + np.pi / 4) % (np.pi / 2) - np.pi / 4)
        price += min(YAW_PRICE * askew, MAX_YAW_PRICE)
        return sum(term.loss(panel) for term in terms) + float(price)

    def trials(self) -> Array:
        """Directions (M, 13) of steps: each number alone, and edges of both boxes together."""
        alone = np.eye(NUMBERS)
        alone[YAW] /= self.size
        # The panel's second axis is the body's third when it stands, its second when it lies.
        second = 2 if abs(self.T_world_panel[2, 1]) > np.sqrt(0.5) else 1
        pairs = [(0, 6), (1, 9), (2, 6 + second), (3, 9 + second)]
        both = [alone[edge] + alone[face] for edge, face in pairs]
        return np.array([sign * trial for trial in (*alone, *both) for sign in (1.0, -1.0)])

    def descend(self, shape: Array, terms: Sequence[Term], steps: Sequence[float]) -> tuple[Array, float]:
        """The best shape that steps lead to, each a share of the panel's diagonal, and its loss.

        Source: pattern search (Hooke and Jeeves, 1961): the loss counts pixels and has no gradient.
        """
        best = self.loss(shape, terms)
        for step in steps:
            before = np.inf
            while best < before:
                before = best
                for trial in step * self.size * self.trials():
                    while (loss := self.loss(shape + trial, terms)) < best - MIN_GAIN:
                        shape, best = shape + trial, loss
        return shape, best


def fit_panel(
    views: Sequence[PromptedView], rng: np.random.Generator, tracked: TrackedPoints | None = None
) -> tuple[Panel, float]:
    """Find the two boxes; they, and how far their extents are from the prompts' (mean `box_misfit`).

    Args:
        views: Prompted images; at least one of each part.
        rng: For the search of the front's plane.
        tracked: Points of which the demonstration shows whether they move.

    Raises:
        ReconstructionError: A prompt shows no surface, or its part is no panel.

    Not checked: the panel is a rectangle, its edges level; the body is a box. Read the misfit.
    """
    found = []
    for T_world_panel, size in _frames([view for view in views if view.part == MOVING], rng):
        front = Plane(normal=T_world_panel[:3, 2], offset=float(T_world_panel[:3, 2] @ T_world_panel[:3, 3]))
        coarse, fine = (
            [Crop.of(view, front, pixels) for view in views] for pixels in (COARSE_PIXELS, FINE_PIXELS)
        )
        points: list[Term] = [] if tracked is None else [tracked.near(T_world_panel, size)]
        for shapes, start in _starts(coarse, T_world_panel, size):
            shape, loss = shapes.descend(start, [*coarse, *points], STEPS[:COARSE])
            found.append((loss, shapes, shape, fine, points))
    if not found:
        raise ReconstructionError(
            STAGE, "the boxes of the moving part show no common front", "draw them around the same part"
        )
    refined = []
    for _, shapes, shape, fine, points in sorted(found, key=lambda item: item[0])[:REFINED]:
        shape, loss = shapes.descend(shape, [*fine, *points], STEPS[COARSE - 1 :])
        refined.append((loss, shapes, shape, fine))
    _, shapes, shape, fine = min(refined, key=lambda item: item[0])
    compared = shapes.panel(shape, 0.5 * SKIN_SHARE)
    misfits = [box_misfit(crop.labels(compared) == crop.part, crop.box) for crop in fine]
    return shapes.panel(shape, SKIN_SHARE), float(np.mean(misfits))


def find_panel_frame(
    points_of_views: list[Array], centers_world: Array, rng: np.random.Generator
) -> tuple[Array, float]:
    """Frame T_world_panel (4, 4) on the largest plane, and the diagonal [m], of what a part's boxes show.

    Args:
        points_of_views: Surface points (N, 3) inside the box, one array a view, world frame.
        centers_world: Camera centres (V, 3); the front faces them.
        rng: For the plane search.

    Raises:
        ReconstructionError: The boxes show almost no surface.
    """
    few = min(len(points) for points in points_of_views)
    if not few >= MIN_PIXELS:
        raise ReconstructionError(
            STAGE,
            f"a box of the moving part shows {few} pixels of surface, want {MIN_PIXELS}",
            "draw it on an image that shows the part",
        )
    count = min(few, 3000)
    points = np.concatenate([p[rng.choice(len(p), count, replace=False)] for p in points_of_views])
    low, high = np.quantile(points, [0.1, 0.9], axis=0)
    size = float(np.linalg.norm(high - low))
    plane, near = find_plane(points, SCATTER_SHARE * size, rng)
    origin, normal = points[near].mean(0), plane.normal
    if (centers_world.mean(0) - origin) @ normal < 0:
        normal = -normal
    up = np.array([0.0, 0.0, 1.0])
    if abs(normal[2]) < np.sin(np.radians(SNAP_DEG)):
        normal = normal * [1, 1, 0] / np.linalg.norm(normal[:2])
    elif abs(normal[2]) > np.cos(np.radians(SNAP_DEG)):
        normal, up = np.array([0.0, 0.0, np.sign(normal[2])]), find_upright_axes(points[near])[:, 0]
    up = up - (up @ normal) * normal
    up /= np.linalg.norm(up)
    return transform(np.stack([np.cross(up, normal), up, normal], 1), origin), size


def _frames(moving: Sequence[PromptedView], rng: np.random.Generator) -> list[tuple[Array, float]]:
    """Frames on the front plane and diagonals: of what boxes show, and of masks where that is another plane."""
    centers = np.array([view.camera.center for view in moving])
    boxed, masked = (
        find_panel_frame([_surface(view, masked=masked) for view in moving], centers, rng)
        for masked in (False, True)
    )
    normals = boxed[0][:3, 2], masked[0][:3, 2]
    apart = abs(float((masked[0][:3, 3] - boxed[0][:3, 3]) @ normals[0]))
    same = normals[0] @ normals[1] > SAME_PLANE_COS and apart < SAME_PLANE_SHARE * boxed[1]
    return [boxed] if same else [boxed, masked]


def _surface(view: PromptedView, *, masked: bool) -> Array:
    """Surface points (N, 3) inside a view's box, also inside the mask that fills it best; world frame."""
    shown = within(view.box, view.points_world.shape[:2])
    mask = min(view.masks, key=lambda mask: box_misfit(mask, view.box), default=None)
    if masked and mask is not None and box_misfit(mask, view.box) < MAX_MASK_MISFIT:
        shown &= mask
    points = view.points_world[shown]
    return points[np.isfinite(points[:, 0])]


def _starts(crops: list[Crop], T_world_panel: Array, size: float) -> list[tuple[Shapes, Array]]:
    """First shapes: the body square to the panel around everything, or level around what its masks show; edges
    from all masks, or common to all boxes."""
    static, moving = ([crop for crop in crops if (crop.part == MOVING) == moves] for moves in (False, True))
    body = np.concatenate([crop.surface(masked=True) for crop in static])
    everything = np.concatenate([body, *(crop.surface(masked=True) for crop in moving)])
    square = upright_axes(np.arctan2(T_world_panel[1, 0], T_world_panel[0, 0]))
    panels = [
        edges for masked in (True, False) for edges in _edges(moving, T_world_panel, size, masked=masked)
    ]
    starts = []
    for axes, points in ((square, everything), (find_upright_axes(body), body)):
        T_world_body = transform(axes, np.median(points, 0))
        corners = np.quantile(apply(invert(T_world_body), points), QUANTILES, axis=0)
        shapes = Shapes(T_world_panel=T_world_panel, T_world_body=T_world_body, size=size)
        starts += [(shapes, np.array([*edges, *corners.ravel(), 0.0])) for edges in panels]
    return starts


def _edges(moving: list[Crop], T_world_panel: Array, size: float, *, masked: bool) -> list[Array]:
    """First edges, seam and reach (6,), from what masks show together or boxes have in common."""
    spans = []
    for crop in moving:
        local = apply(invert(T_world_panel), crop.surface(masked=masked))
        near = local[np.abs(local[:, 2]) < FRONT_SHARE * size]
        if len(near) < MIN_FRONT_PIXELS:
            return []
        spans.append(np.quantile(near[:, :2], EDGE_QUANTILES, axis=0))
    lows, highs = np.moveaxis(np.array(spans), 1, 0)
    low, high = (lows.min(0), highs.max(0)) if masked else (lows.max(0), highs.min(0))
    return [
        np.array([low[0], high[0], low[1], high[1], -seam * size, REACH_SHARE * size]) for seam in SEAM_SHARES
    ]


def _box(T_world_frame: Array, low: Array, high: Array) -> OrientedBox:
    R = T_world_frame[:3, :3]
    center = T_world_frame[:3, 3] + R @ (low + high) / 2
    return OrientedBox(T_world_box=transform(R, center), half_extents=(high - low) / 2)
