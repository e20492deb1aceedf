"""An object as two boxes: the moving part, a panel, and the body; and how well evidence agrees with them.

Masks of doors, drawers and lids are ragged or stop at a window; the boxes make the borders straight.
Panel frame: x level along the panel, y up (across, for a lid), z out of the front, origin on the front face.
Body frame: z up.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.boxes import OrientedBox
from aomgen.core.gaussians import Gaussians
from aomgen.core.planes import Plane
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze
from aomgen.parts.prompted_images import PromptedView, box_misfit, iou, share_inside, within
from aomgen.segmentation.interface import Mask

# A mask beside a box: segmenters are wrong by whole faces, people by a few pixels.
MASK_WEIGHT = 0.5
# A mask whose own extent is this far from its box (see `box_misfit`), of which less than this share is inside the
# box, or that is this much farther from it than another, shows something else.
MAX_MASK_MISFIT, MIN_SHARE_INSIDE, MASK_SPREAD = 0.25, 0.5, 0.1
# Log odds (e = 2.7 to 1) from which a point is known to move or to stand; a few large Gaussians do not speak for
# all: areas are cut at this quantile; points farther from the panel than so many diagonals are of other things.
MIN_LOG_ODDS, LARGEST_QUANTILE, NEAR_SHARE = 1.0, 0.95, 1.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Where the two boxes are, world frame; what lies in both belongs to the moving part.

    Attributes:
        moving: Axes of the panel frame; from the seam behind the panel to where handles reach.
        body: Box of the object's body.
        front_m: Place of the front face along the third axis of `moving`, from its centre, [m].
    """

    moving: OrientedBox
    body: OrientedBox
    front_m: float

    @property
    def front(self) -> Plane:
        """Plane of the front face, normal outward."""
        T = self.moving.T_world_box
        return Plane(normal=T[:3, 2], offset=float(T[:3, 2] @ T[:3, 3]) + self.front_m)

    def labels(self, points_world: Array, fronts_world: Array | None = None) -> NDArray[np.uint8]:
        """Part labels (N,) of points (N, 3) by where they are.

        Args:
            points_world: The points; NaN is background.
            fronts_world: Where the rays that show them pass the front, see `meet_front`: a panel is opaque,
                what appears behind its face, mirrored or seen through glass, is it.
        """
        ours, moves = self.body.contains(points_world), self.moving.contains(points_world)
        if fronts_world is not None:
            moves |= ours & self.moving.contains(fronts_world)
        labels = np.full(len(ours), BACKGROUND, np.uint8)
        labels[ours] = STATIC
        labels[moves] = MOVING
        return labels

    def labels_seen(self, points_world: Array, center_world: Array) -> NDArray[np.uint8]:
        """Part labels (H, W) of the surface points (H, W, 3), NaN for none, that a camera at (3,) sees."""
        points = points_world.reshape(-1, 3)
        fronts = meet_front(points, center_world, self.front)
        return self.labels(points, fronts).reshape(points_world.shape[:2])

    @property
    def uncovered_m(self) -> float:
        """How far the front's corners stand out past the body's footprint, mean over the corners, [m]."""
        x, y, _ = self.moving.half_extents
        corners = np.array([[sx * x, sy * y, self.front_m] for sx in (-1, 1) for sy in (-1, 1)])
        body = self.body.coordinates(apply(self.moving.T_world_box, corners))
        return float(np.maximum(np.abs(body) - self.body.half_extents, 0)[:, :2].sum(1).mean())


def meet_front(points: Array, center: Array, front: Plane) -> Array:
    """Where rays from a camera at (3,) to points (N, 3) behind a front pass it (N, 3); NaN for others."""
    above, heights = float(front.heights(center)), front.heights(points)
    passing = (heights < 0) & (above > 0)
    shares = np.where(passing, above / np.where(passing, above - heights, 1.0), np.nan)
    return center + shares[:, None] * (points - center)


class Term(Protocol):
    """One loss term of the boxes."""

    def loss(self, panel: Panel) -> float:
        """Loss of the boxes, 0 at best."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedPoints:
    """Points (N, 3), world frame, whether they move (N,), and weights (N,), area times certainty.

    Known from the grasp and from tracks in the video.
    """

    points: Array
    moves: NDArray[np.bool_]
    weights: Array

    def __post_init__(self) -> None:
        freeze(self, "points", self.points, (None, 3))
        freeze(self, "moves", self.moves, (len(self.points),), np.bool_)
        freeze(self, "weights", self.weights, (len(self.points),))

    @staticmethod
    def of(gaussians: Gaussians, log_odds: Array) -> "TrackedPoints":
        """Those Gaussians, world frame, whose log odds of moving over standing still (N,) tell."""
        told = np.abs(log_odds) >= MIN_LOG_ODDS
        sizes = np.sort(gaussians.scales[told], axis=1)[:, 1:].prod(1)
        sizes = np.minimum(sizes, np.quantile(sizes, LARGEST_QUANTILE)) if len(sizes) else sizes
        return TrackedPoints(
            points=gaussians.means[told].astype(np.float64),
            moves=log_odds[told] > 0,
            weights=sizes * gaussians.opacities[told] * np.abs(log_odds[told]),
        )

    def near(self, T_world_panel: Array, size: float) -> "TrackedPoints":
        """Those around a panel of a diagonal `size` [m]."""
        kept = (np.abs(apply(invert(T_world_panel), self.points)) < NEAR_SHARE * size).all(1)
        return TrackedPoints(points=self.points[kept], moves=self.moves[kept], weights=self.weights[kept])

    def loss(self, panel: Panel) -> float:
        """Distance, 1 - IoU, of what moves by the panel from what was seen to move; 0 where nothing was."""
        found = panel.labels(self.points) == MOVING
        either = float(self.weights @ (found | self.moves))
        return 1.0 - float(self.weights @ (found & self.moves)) / either if either > 0 else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Crop:
    """Every n-th pixel (H, W) of a prompted view around its box.

    Attributes:
        part: `STATIC` or `MOVING`.
        points, fronts: (H * W, 3), see `Panel.labels`.
        box: (4,) in pixels of the crop.
        masks: Answers (H, W) that fit the box, cut at it.
        inside: Pixels (H, W) of the box.
    """

    part: int
    points: Array
    fronts: Array
    box: Array
    masks: tuple[Mask, ...]
    inside: Mask

    @staticmethod
    def of(view: PromptedView, front: Plane, pixels: int) -> "Crop":
        """About so many pixels of a view."""
        height, width = view.points_world.shape[:2]
        margin = 0.25 * (view.box[2:] - view.box[:2])
        x0, y0 = np.maximum(view.box[:2] - margin, 0).astype(int)
        x1, y1 = np.minimum(view.box[2:] + margin, [width, height]).astype(int)
        stride = max(1, int(np.sqrt((x1 - x0) * (y1 - y0) / pixels)))
        window = (slice(y0, y1, stride), slice(x0, x1, stride))
        inside = within(view.box, (height, width))
        # Masks bleed over the border of what was boxed.
        kept = [mask & inside for mask in view.masks if share_inside(mask, view.box) > MIN_SHARE_INSIDE]
        misfits = [box_misfit(mask, view.box) for mask in kept]
        limit = min([MAX_MASK_MISFIT, *(misfit + MASK_SPREAD for misfit in misfits)])
        points = view.points_world[window].reshape(-1, 3)
        return Crop(
            part=view.part,
            points=points,
            fronts=meet_front(points, view.camera.center, front),
            box=(view.box - [x0, y0, x0, y0]) / stride,
            masks=tuple(m[window] for m, misfit in zip(kept, misfits, strict=True) if misfit < limit),
            inside=inside[window],
        )

    def labels(self, panel: Panel) -> NDArray[np.uint8]:
        """(H, W), of the boxes."""
        return panel.labels(self.points, self.fronts).reshape(self.inside.shape)

    def loss(self, panel: Panel) -> float:
        """Misfit of the box, and distance to the mask that agrees best."""
        labels = self.labels(panel)
        shown = labels == self.part
        # Segmenters find whole objects best, also where a person boxed the body of one.
        wanted = (shown,) if self.part == MOVING else (shown, labels != BACKGROUND)
        apart = min(
            (1 - iou(item & self.inside, mask) for mask in self.masks for item in wanted), default=0.0
        )
        return box_misfit(shown, self.box) + MASK_WEIGHT * apart

    def surface(self, *, masked: bool) -> Array:
        """Surface points (N, 3) in the box, or in the mask that agrees with it best."""
        masks = self.masks if masked else ()
        shown = min(masks, key=lambda mask: box_misfit(mask, self.box), default=self.inside)
        points = self.points[shown.ravel()]
        return points[np.isfinite(points[:, 0])]
