"""Prompted images with their surface points and the masks of each box."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.recording import Prompt
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.parts.panel import STAGE
from aomgen.parts.panel_terms import PromptedView, box_misfit, iou, share_inside
from aomgen.parts.scan_views import ScanView, render_parts
from aomgen.segmentation.interface import Mask, PreparedImage, Segmenter, bound_mask
from aomgen.segmentation.segmenter import MasksOnDisk
from aomgen.splatting.surfaces import compute_surface_points

# A mask this close to its box (see `box_misfit`; 2.5 % of the box a side) is used as it is.
MAX_MISFIT = 0.1
# Other masks are joined with masks of a grid with this number of points a side, of which this share is inside the box.
GRID, MIN_INSIDE = 6, 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptedImage:
    """One box on one scan image, and the masks of the segmenter for it; none of them is empty.

    Attributes:
        view: The image.
        prepared: The image, encoded for further masks.
        part: `STATIC` or `MOVING`.
        box: (4,) x0, y0, x1, y1, [px].
        masks: (H, W), without the robot.
    """

    view: ScanView
    prepared: PreparedImage
    part: int
    box: Array
    masks: tuple[Mask, ...]

    @property
    def best_mask(self) -> Mask:
        """The mask whose extent is closest to the box."""
        empty = np.zeros_like(self.view.robot)
        return min(self.masks, key=lambda mask: box_misfit(mask, self.box), default=empty)

    def on_surface(self, gaussians: Gaussians) -> PromptedView:
        """Add the surface of the Gaussians in this view."""
        points = find_surface(gaussians, self.view)
        return PromptedView(
            part=self.part, camera=self.view.camera, points_world=points, box=self.box, masks=self.masks
        )


def compare_with_prompts(
    gaussians: Gaussians, labels: NDArray[np.uint8], prompted: list[PromptedImage]
) -> tuple[float, dict[int, float]]:
    """Compare labels (N,) of Gaussians, world frame, rendered into the prompted images, with the prompts.

    Returns:
        The `box_misfit`, mean over the prompts; and the IoU with the mask that agrees best, mean over the prompts of
        a part, by part.
    """
    misfits: list[float] = []
    overlaps: dict[int, list[float]] = {STATIC: [], MOVING: []}
    for item in prompted:
        rendered = render_parts(gaussians, labels, item.view.camera)[item.part] & ~item.view.robot
        misfits.append(box_misfit(rendered, item.box))
        overlaps[item.part].append(max((iou(rendered, mask) for mask in item.masks), default=0.0))
    return float(np.mean(misfits)), {part: float(np.mean(values)) for part, values in overlaps.items()}


def segment_prompts(
    views: list[ScanView], prompts: tuple[Prompt, ...], segmenter: Segmenter
) -> list[PromptedImage]:
    """Segment every box of the object's parts, with and without its points.

    A point may pull a mask to a detail (a label, a window), its absence to a neighbor.

    Raises:
        ReconstructionError: A part has no box on an image that has a camera.
    """
    by_name = {view.name: view for view in views}
    prepared: dict[str, PreparedImage] = {}
    segmented = []
    for part, value in (("static", STATIC), ("moving", MOVING)):
        boxed = [p for p in prompts if p.part == part and len(p.box) == 4 and p.image in by_name]
        if not boxed:
            raise ReconstructionError(STAGE, f"no box prompts the {part} part", "add one to capture.toml")
        for prompt in boxed:
            view = by_name[prompt.image]
            if view.name not in prepared:
                prepared[view.name] = segmenter.prepare(view.name, view.image_srgb)
            image = prepared[view.name]
            clicks = [np.zeros((0, 3)), prompt.points] if len(prompt.points) else [prompt.points]
            masks = [image.mask(part, prompt.box, points) & ~view.robot for points in clicks]
            box = np.asarray(prompt.box, np.float64)
            if isinstance(segmenter, MasksOnDisk) and masks[0].any():
                # Label images are edited by people, and are more accurate than a box around them.
                box = bound_mask(masks[0])
            masks = [mask for mask in _fill_box(masks, image, box, view.robot) if mask.any()]
            segmented.append(
                PromptedImage(view=view, prepared=image, part=value, box=box, masks=tuple(masks))
            )
    return segmented


def _fill_box(masks: list[Mask], image: PreparedImage, box: Array, robot: Mask) -> list[Mask]:
    """Add, where no mask (H, W) fills the box, the best one joined with further masks in the box.

    Segmenters divide parts of several colors. A missing piece is inside the box, and with it the mask fills the box at
    least twice as well; details and objects behind the part change little.
    """
    best = min(masks, key=lambda mask: box_misfit(mask, box))
    if box_misfit(best, box) <= MAX_MISFIT:
        return masks
    height, width = robot.shape
    columns, rows = (np.linspace(box[k], box[k + 2], GRID + 2)[1:-1].astype(int) for k in (0, 1))
    free = [
        (column, row)
        for row in rows[(rows >= 0) & (rows < height)]
        for column in columns[(columns >= 0) & (columns < width)]
        if not (best[row, column] or robot[row, column])
    ]
    if not free:
        return masks
    pieces = [piece & ~robot for piece in image.at_points(np.array(free) + 0.5).masks]
    pieces = [p for p in pieces if p.any() and share_inside(p, box) >= MIN_INSIDE]
    joined = best
    while pieces:
        found = min(pieces, key=lambda piece: box_misfit(joined | piece, box))
        if not box_misfit(joined | found, box) < box_misfit(joined, box):
            break
        joined = joined | found
    return [*masks, joined] if box_misfit(joined, box) < box_misfit(best, box) / 2 else masks


def find_surface(gaussians: Gaussians, view: ScanView) -> Array:
    """Compute world points (H, W, 3) of the surface at each pixel of a view; NaN without a surface, and on the robot."""
    return np.where(view.robot[..., None], np.nan, compute_surface_points(gaussians, view.camera))
