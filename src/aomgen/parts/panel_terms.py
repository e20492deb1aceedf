"""Loss terms of a panel (see `panel`): prompt boxes and masks of images, and points with a known motion."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND, MOVING
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze_arrays
from aomgen.parts.panel import Panel
from aomgen.segmentation.interface import Mask

# A mask is used only if its `box_misfit` is below MAX_MASK_MISFIT and less than MASK_SPREAD above that of the best mask, and if
# more than MIN_SHARE_INSIDE of it lies in the box. Other masks show another object.
MAX_MASK_MISFIT, MASK_SPREAD, MIN_SHARE_INSIDE = 0.25, 0.1, 0.5
# Weight of a mask relative to a box: segmenters may miss whole faces, manual boxes have errors of a few pixels.
MASK_WEIGHT = 0.5
# Least absolute log-likelihood ratio of a point that is used: e = 2.7 to 1.
MIN_LOG_RATIO = 1.0
# Points farther from the panel than this, as share of its diagonal, belong to other objects.
MAX_DISTANCE_SHARE = 1.2
# Areas of Gaussians are limited to this quantile, so that a few large ones do not outweigh all others.
LARGEST_QUANTILE = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptedView:
    """A prompted image and the surface it shows.

    Attributes:
        part: `STATIC` or `MOVING`.
        camera: World frame.
        points_world: (H, W, 3) surface point at each pixel, NaN where there is none or the robot.
        box: (4,) x0, y0, x1, y1 of the prompt, [px].
        masks: Masks (H, W) by the segmenter, any number.
    """

    part: int
    camera: Camera
    points_world: Array
    box: Array
    masks: tuple[Mask, ...]


def box_misfit(mask: Mask, box: Array) -> float:
    """Compute the distance between the extent of a mask (H, W) and a box: 0 if the mask touches all sides from inside.

    The result is the sum of the distances of the four sides, as shares of the box, and twice the share of the mask outside.
    Single pixels do not determine the extent. Without a mask the result is 4, a whole box for each side.
    """
    total = np.count_nonzero(mask)
    width, height = box[2] - box[0], box[3] - box[1]
    columns = np.flatnonzero(mask.sum(0) > max(1.0, 0.015 * height))
    rows = np.flatnonzero(mask.sum(1) > max(1.0, 0.015 * width))
    if not (total and len(columns) and len(rows)):
        return 4.0
    gaps = abs(columns[0] - box[0]) + abs(columns[-1] + 1 - box[2])
    heights = abs(rows[0] - box[1]) + abs(rows[-1] + 1 - box[3])
    return float(gaps / width + heights / height + 2 * (1 - share_inside(mask, box)))


def pixels_within(box: Array, shape: tuple[int, ...]) -> Mask:
    """Mark the pixels (H, W) of a box x0, y0, x1, y1, [px]."""
    rows, columns = np.arange(shape[0])[:, None] + 0.5, np.arange(shape[1]) + 0.5
    return (columns > box[0]) & (columns < box[2]) & (rows > box[1]) & (rows < box[3])


def share_inside(mask: Mask, box: Array) -> float:
    """Compute the share of a mask (H, W) inside a box x0, y0, x1, y1, [px]; 0 for an empty mask."""
    x0, y0 = np.maximum(np.floor(box[:2]), 0).astype(int)
    x1, y1 = np.ceil(box[2:]).astype(int)
    return np.count_nonzero(mask[y0:y1, x0:x1]) / max(1, np.count_nonzero(mask))


def iou(first: Mask, second: Mask) -> float:
    """Compute the intersection over union of two masks."""
    return np.count_nonzero(first & second) / max(1, np.count_nonzero(first | second))


@dataclass(frozen=True, slots=True, kw_only=True)
class Crop:
    """Every n-th pixel of a prompted view around its box, panel frame.

    `local` (H, W, 3) has one contiguous plane of memory for each coordinate; `center` is the camera's.
    """

    part: int
    local: Array
    center: Array
    box: Array
    masks: tuple[Mask, ...]
    inside_box: Mask

    @staticmethod
    def of(view: PromptedView, T_world_panel: Array, pixels: int) -> "Crop":
        """Crop a view to at most about `pixels` pixels."""
        height, width = view.points_world.shape[:2]
        margin = 0.25 * (view.box[2:] - view.box[:2])
        x0, y0 = np.maximum(view.box[:2] - margin, 0).astype(int)
        x1, y1 = np.minimum(view.box[2:] + margin, [width, height]).astype(int)
        stride = max(1, round(np.sqrt((x1 - x0) * (y1 - y0) / pixels)))
        window = (slice(y0, y1, stride), slice(x0, x1, stride))
        inside = pixels_within(view.box, (height, width))
        # Masks extend beyond the border of the boxed part; a mask that is mostly outside shows another object.
        kept = [mask & inside for mask in view.masks if share_inside(mask, view.box) > MIN_SHARE_INSIDE]
        misfits = [box_misfit(mask, view.box) for mask in kept]
        limit = min([MAX_MASK_MISFIT, *(misfit + MASK_SPREAD for misfit in misfits)])
        T_panel_world = invert(T_world_panel)
        points = apply(T_panel_world, view.points_world[window].reshape(-1, 3)).T
        planes = np.ascontiguousarray(points.astype(np.float32).astype(np.float64))
        return Crop(
            part=view.part,
            local=np.moveaxis(planes.reshape(3, *view.points_world[window].shape[:2]), 0, -1),
            center=apply(T_panel_world, view.camera.center[None])[0],
            box=(view.box - [x0, y0, x0, y0]) / stride,
            masks=tuple(m[window] for m, misfit in zip(kept, misfits, strict=True) if misfit < limit),
            inside_box=inside[window],
        )

    def misfit(self, panel: Panel) -> float:
        """Compute the distance between the box and the extent of the part, see `box_misfit`."""
        return box_misfit(panel.labels_local(self.local, self.center) == self.part, self.box)

    def loss(self, panel: Panel) -> float:
        """Add the misfit of the box and the distance to the mask that agrees best."""
        labels = panel.labels_local(self.local, self.center)
        shown = labels == self.part
        # Segmenters often return the whole object for a box around its body.
        expected = (shown,) if self.part == MOVING else (shown, labels != BACKGROUND)
        apart = min(
            (1 - iou(item & self.inside_box, mask) for mask in self.masks for item in expected), default=0.0
        )
        return box_misfit(shown, self.box) + MASK_WEIGHT * apart

    def surface(self, *, masked: bool) -> Array:
        """Select surface points (N, 3) in the mask that agrees with the box best, or else in the box."""
        if masked and self.masks:
            points = self.local[min(self.masks, key=lambda mask: box_misfit(mask, self.box))]
        else:
            x0, y0, x1, y1 = np.maximum(np.rint(self.box), 0).astype(int)
            points = self.local[y0:y1, x0:x1].reshape(-1, 3)
        return points[np.isfinite(points[:, 0])]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedPoints:
    """Points with a known motion.

    Attributes:
        points: (N, 3), world frame; panel frame once `near` a panel, [m].
        moves: (N,).
        weights: (N,), area times log-likelihood ratio.
    """

    points: Annotated[Array, "N 3"]
    moves: Annotated[NDArray[np.bool_], "N"]
    weights: Annotated[Array, "N"]

    __post_init__ = freeze_arrays

    @staticmethod
    def of(gaussians: Gaussians, log_ratios: Array) -> "TrackedPoints":
        """Select Gaussians, world frame, whose log-likelihood ratio (N,) of moving to resting is decisive."""
        known = np.abs(log_ratios) >= MIN_LOG_RATIO
        sizes = np.sort(gaussians.scales[known], axis=1)[:, 1:].prod(1)
        sizes = np.minimum(sizes, np.quantile(sizes, LARGEST_QUANTILE)) if len(sizes) else sizes
        return TrackedPoints(
            points=gaussians.means[known].astype(np.float64),
            moves=log_ratios[known] > 0,
            weights=sizes * gaussians.opacities[known] * np.abs(log_ratios[known]),
        )

    def near(self, T_world_panel: Array, size_m: float) -> "TrackedPoints":
        """Select points around a panel of this diagonal, panel frame."""
        local = apply(invert(T_world_panel), self.points)
        kept = (np.abs(local) < MAX_DISTANCE_SHARE * size_m).all(1)
        return TrackedPoints(points=local[kept], moves=self.moves[kept], weights=self.weights[kept])

    def loss(self, panel: Panel) -> float:
        """Compute the distance, 1 - IoU, between points inside the moving part and points that move; 0 if none move."""
        found = panel.labels_local(self.points) == MOVING
        either = float(self.weights @ (found | self.moves))
        return 1.0 - float(self.weights @ (found & self.moves)) / either if either > 0 else 0.0
