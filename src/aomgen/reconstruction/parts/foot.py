"""What of an object lies so flat on its support that a scan does not tell the heights of both apart.

Plates under stands and edges of thin things are a few millimeters high, less than surfaces scatter. Within the
object's footprint, and as low as its panel's box ends, the segmenter's masks say what is object.
"""

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.reconstruction.parts.panel import Panel, lower_face
from aomgen.reconstruction.parts.panel_crops import MAX_MASK_MISFIT, box_misfit
from aomgen.reconstruction.parts.part_masks import shown_by
from aomgen.reconstruction.parts.prompted import PromptedImage

# As high above and below the end of the box, as share of the object's diagonal.
BAND_SHARE = 0.03


def with_foot(
    gaussians: Gaussians, labels: NDArray[np.uint8], panel: Panel, prompted: list[PromptedImage]
) -> NDArray[np.uint8]:
    """Labels (N,) in which background that masks of the static part show at the object's foot is static.

    Args:
        gaussians: The scan, world frame.
        labels: (N,) by the panel.
        panel: Of the object.
        prompted: Answers to the prompts; masks that do not fill their boxes are not asked.
    """
    axis, side = lower_face(panel.T_world_body)
    low, high = panel.object_low, panel.object_high
    local = apply(invert(panel.T_world_body), np.asarray(gaussians.means, np.float64))
    bottom = (low, high)[side][axis]
    across = [k for k in range(3) if k != axis]
    footprint = np.all((local[:, across] > low[across]) & (local[:, across] < high[across]), axis=1)
    band = BAND_SHARE * float(np.linalg.norm(high - low))
    at_foot = footprint & (np.abs(local[:, axis] - bottom) < band) & (labels == BACKGROUND)
    clipped = [
        (item, item.best_mask & _within(item.box, item.view.robot.shape))
        for item in prompted
        if item.part == STATIC
    ]
    masks = ((item.view, mask) for item, mask in clipped if box_misfit(mask, item.box) < MAX_MASK_MISFIT)
    shown, _ = shown_by(gaussians, masks)
    return np.where(at_foot & shown, STATIC, labels).astype(np.uint8)


def _within(box: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Pixels (H, W) of a box x0, y0, x1, y1, [px]."""
    rows, columns = np.arange(shape[0])[:, None] + 0.5, np.arange(shape[1]) + 0.5
    return (columns > box[0]) & (columns < box[2]) & (rows > box[1]) & (rows < box[3])
