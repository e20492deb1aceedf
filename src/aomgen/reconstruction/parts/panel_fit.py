"""Finding the panel (see `panel`) that explains the boxes a person drew.

A box drawn around a part touches it on all four sides, in every prompted image at once: that is
stronger evidence than any single mask. Masks that fill their box count beside it, those that do
not (a window instead of its door) are left out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, STATIC
from aomgen.core.camera import Camera
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.reconstruction.masks.segmenter import Mask
from aomgen.reconstruction.parts.panel import Panel
from aomgen.reconstruction.parts.panel_front import panel_frame

STAGE = "parts"
# A mask whose own extent is this far from its box (see `box_misfit`) shows something else.
MAX_MASK_MISFIT = 0.25
# Steps of the search, as shares of the panel's diagonal: coarse ones on fewer pixels.
COARSE_STEPS = (0.2, 0.1, 0.05, 0.025)
FINE_STEPS = (0.05, 0.025, 0.012, 0.006, 0.003)
# The seam shows at the panel's edges only, where other numbers make up for a wrong one: it is looked for from
# these places too, as shares of the panel's diagonal.
SEAM_SHARES = (0.01, 0.03)
# Most steps in one direction at once: far starts (a wall behind the object) are walked back so.
MAX_STRIDES = 50
COARSE_PIXELS, FINE_PIXELS = 3_000, 16_000
MIN_FRONT_PIXELS = 20
# Thickness of the object's outer faces, in which their Gaussians scatter, as share of the panel's
# diagonal; half of it while boxes are compared, which show where the face itself is.
SKIN_SHARE = 0.02
# Of the numbers of `Panel.of_shape`: how far the object goes beyond the panel, never negative; how far
# handles stand out past its edges.
OVERHANG = [6, 7, 8, 9, 11]
BESIDE = slice(12, 16)
# Handles past an edge are looked for up to this share of the panel's diagonal; masks of every prompted view
# have to agree better with one, by this loss (0.6 % of the mask): one view alone takes other things for it.
MAX_BESIDE_SHARE, BESIDE_STEP_SHARE = 0.15, 0.01
BESIDE_GAIN = 0.003
# A mask beside a box: segmenters are wrong by whole faces, people by a few pixels.
MASK_WEIGHT = 0.5
# Price of size, so that edges lie on the outermost points and not somewhere in the air beyond.
SIZE_PRICE = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptedView:
    """A prompted image and the surface it shows.

    Attributes:
        part: `STATIC` or `MOVING`.
        camera: World frame.
        points_world: (H, W, 3) surface point at each pixel, NaN where there is none or the robot.
        box: (4,) x0, y0, x1, y1 of the prompt, [px].
        masks: Answers (H, W) of the segmenter, any number.
    """

    part: int
    camera: Camera
    points_world: Array
    box: Array
    masks: tuple[Mask, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class PanelFit:
    """A panel and how far its extents are from the prompts' boxes, one `box_misfit` a view."""

    panel: Panel
    misfits: tuple[float, ...]


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
    coarse = [_Crop.of(view, T_world_panel, COARSE_PIXELS) for view in views]
    fine = [_Crop.of(view, T_world_panel, FINE_PIXELS) for view in views]
    search = _Search(T_world_panel=T_world_panel, size=size)
    tried = [_start(coarse, size, masked=masked) for masked in (True, False)]
    starts = [start for start in tried if start is not None]
    if not starts:
        raise ReconstructionError(
            STAGE, "the boxes of the moving part show no common front", "draw them around the same part"
        )
    found = [search.descend(start, coarse, COARSE_STEPS) for start in starts]
    shape = min(found, key=lambda item: item[1])[0]
    starts = [shape, *(_with_seam(shape, -share * size) for share in SEAM_SHARES)]
    found = [search.descend(start, fine, FINE_STEPS) for start in starts]
    shape = min(found, key=lambda item: item[1])[0]
    shape = search.with_handles(shape, fine)
    misfits = tuple(crop.misfit(search.panel(shape)) for crop in fine)
    return PanelFit(panel=Panel.of_shape(T_world_panel, shape, SKIN_SHARE * size), misfits=misfits)


def _with_seam(shape: Array, seam_m: float) -> Array:
    """A shape with another seam; the object's back stays behind it."""
    changed = shape.copy()
    changed[4], changed[10] = seam_m, min(shape[10], 2 * seam_m)
    return changed


def _surface(view: PromptedView) -> Array:
    """Surface points (N, 3) inside a view's box, world frame."""
    x0, y0, x1, y1 = np.maximum(np.rint(view.box), 0).astype(int)
    points = view.points_world[y0:y1, x0:x1].reshape(-1, 3)
    return points[np.isfinite(points[:, 0])]


def _start(crops: list["_Crop"], size: float, *, masked: bool) -> Array | None:
    """A first shape from what the masks show, or from what the boxes have in common; None without a front."""
    fronts = []
    for crop in crops:
        points = crop.inside(masked=masked)
        if crop.part == MOVING:
            points = points[np.abs(points[:, 2]) < 0.05 * size]
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
    seam = -0.05 * size
    depth = [seam, 0.2 * size, *beyond, min(outer_low[2], 2 * seam), 0.0]
    return np.array([low[0], high[0], low[1], high[1], *depth, *np.zeros(4)])


def box_misfit(mask: Mask, box: Array) -> float:
    """How badly a mask (H, W) fits a box drawn around it: 0 when it touches all sides from inside.

    The distances of the four sides, as shares of the box, and twice the share of the mask outside.
    Single pixels do not make an extent. Without a mask it is 4: each side off by the whole box.
    """
    total = int(mask.sum())
    width, height = box[2] - box[0], box[3] - box[1]
    columns = np.flatnonzero(mask.sum(0) > max(1.0, 0.015 * height))
    rows = np.flatnonzero(mask.sum(1) > max(1.0, 0.015 * width))
    if not (total and len(columns) and len(rows)):
        return 4.0
    gaps = abs(columns[0] - box[0]) + abs(columns[-1] + 1 - box[2])
    heights = abs(rows[0] - box[1]) + abs(rows[-1] + 1 - box[3])
    x0, y0 = np.maximum(np.floor(box[:2]), 0).astype(int)
    x1, y1 = np.ceil(box[2:]).astype(int)
    return float(gaps / width + heights / height + 2 * (1 - mask[y0:y1, x0:x1].sum() / total))


def iou(first: Mask, second: Mask) -> float:
    """Intersection over union of two masks."""
    return float((first & second).sum() / max(1, (first | second).sum()))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Crop:
    """Every n-th pixel of a prompted view around its box, panel frame."""

    part: int
    local: NDArray[np.float32]
    center: Array
    box: Array
    masks: tuple[Mask, ...]

    @staticmethod
    def of(view: PromptedView, T_world_panel: Array, pixels: int) -> "_Crop":
        height, width = view.points_world.shape[:2]
        margin = 0.25 * (view.box[2:] - view.box[:2])
        x0, y0 = np.maximum(view.box[:2] - margin, 0).astype(int)
        x1, y1 = np.minimum(view.box[2:] + margin, [width, height]).astype(int)
        stride = max(1, int(np.sqrt((x1 - x0) * (y1 - y0) / pixels)))
        window = (slice(y0, y1, stride), slice(x0, x1, stride))
        T_panel_world = invert(T_world_panel)
        points = view.points_world[window]
        return _Crop(
            part=view.part,
            local=apply(T_panel_world, points.reshape(-1, 3)).reshape(points.shape).astype(np.float32),
            center=apply(T_panel_world, view.camera.center[None])[0],
            box=(view.box - [x0, y0, x0, y0]) / stride,
            masks=tuple(m[window] for m in view.masks if box_misfit(m, view.box) < MAX_MASK_MISFIT),
        )

    def shown(self, panel: Panel) -> Mask:
        return panel.labels_local(self.local, self.center) == self.part

    def misfit(self, panel: Panel) -> float:
        return box_misfit(self.shown(panel), self.box)

    def loss(self, panel: Panel) -> float:
        """Misfit of the box, and distance to the mask that agrees best."""
        shown = self.shown(panel)
        apart = min((1 - iou(shown, mask) for mask in self.masks), default=0.0)
        return box_misfit(shown, self.box) + MASK_WEIGHT * apart

    def inside(self, *, masked: bool) -> NDArray[np.float32]:
        """Surface points (N, 3) in the mask that agrees with the box best, else in the box."""
        if masked and self.masks:
            points = self.local[min(self.masks, key=lambda mask: box_misfit(mask, self.box))]
        else:
            x0, y0, x1, y1 = np.maximum(np.rint(self.box), 0).astype(int)
            points = self.local[y0:y1, x0:x1].reshape(-1, 3)
        return points[np.isfinite(points[:, 0])]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Search:
    """Coordinate descent over the shape of `Panel.of_shape`."""

    T_world_panel: Array
    size: float

    def panel(self, shape: Array) -> Panel:
        return Panel.of_shape(self.T_world_panel, shape, 0.5 * SKIN_SHARE * self.size)

    def loss(self, shape: Array, crops: list[_Crop]) -> float:
        left, right, lower, upper, seam, reach = shape[:6]
        if not (left < right and lower < upper and shape[10] < seam < 0 < reach):
            return np.inf
        sizes = right - left + upper - lower - shape[10] - seam
        extent = sizes + shape[OVERHANG].sum() + shape[BESIDE].sum()
        panel = self.panel(shape)
        return sum(crop.loss(panel) for crop in crops) + SIZE_PRICE * extent / self.size

    def descend(self, shape: Array, crops: list[_Crop], steps: tuple[float, ...]) -> tuple[Array, float]:
        best = self.loss(shape, crops)
        for step in self.size * np.array(steps):
            for _ in range(4):
                before = best
                for trial in self._trials(shape, step):
                    for _ in range(MAX_STRIDES):
                        moved = shape + trial
                        moved[OVERHANG] = np.maximum(moved[OVERHANG], 0)
                        loss = self.loss(moved, crops)
                        if not loss < best - 1e-4:
                            break
                        shape, best = moved, loss
                if not best < before:
                    break
        return shape, best

    def with_handles(self, shape: Array, crops: list[_Crop]) -> Array:
        """The shape with handles past the panel's edges where the masks of every view show one."""
        moving = [crop for crop in crops if crop.part == MOVING]
        steps = np.arange(BESIDE_STEP_SHARE, MAX_BESIDE_SHARE, BESIDE_STEP_SHARE) * self.size
        for edge in range(BESIDE.start, BESIDE.stop):
            before = np.array([crop.loss(self.panel(shape)) for crop in moving])
            best, found = self.loss(shape, crops), shape
            for step in steps:
                wider = shape.copy()
                wider[edge] = step
                gains = before - [crop.loss(self.panel(wider)) for crop in moving]
                loss = self.loss(wider, crops)
                if loss < best and (gains > BESIDE_GAIN).all():
                    best, found = loss, wider
            shape = found
        return shape

    def _trials(self, shape: Array, step: float) -> list[Array]:
        """Each number up and down; edges of the panel also with the object's outline held still."""
        trials = []
        for index in range(BESIDE.start):
            for sign in (1.0, -1.0):
                change = np.zeros(len(shape))
                change[index] = sign * step
                if index < 4:
                    held = change.copy()
                    held[6 + index] = sign * step if index % 2 == 0 else -sign * step
                    trials.append(held)
                trials.append(change)
        return trials
