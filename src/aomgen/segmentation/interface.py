"""Interface of segmenters, which compute masks of an image from boxes or points."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy.ndimage import binary_closing, binary_fill_holes, binary_opening, label

from aomgen.core.values import freeze_arrays

Mask = NDArray[np.bool_]


def bound_mask(mask: Mask) -> NDArray[np.float64]:
    """Return the bounding box x0, y0, x1, y1 (4,), [px], of a mask (H, W) with at least one pixel."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float64)


class Segmenter(Protocol):
    """Computation of masks from boxes and points on an image."""

    def prepare(self, name: str, image_srgb: NDArray[np.uint8]) -> "PreparedImage":
        """Perform the computations that all prompts on an image share, for example its encoding.

        Args:
            name: File name of the image.
            image_srgb: Image (H, W, 3), sRGB.
        """
        ...


class PreparedImage(Protocol):
    """An image for which a segmenter accepts prompts."""

    def mask(self, part: str, box_px: ArrayLike, points: ArrayLike) -> Mask:
        """Compute the mask (H, W) of a part.

        Args:
            part: "moving", "static" or "object" (both); only label images use it.
            box_px: Bounding box x0, y0, x1, y1 of the part (4,), [px]; empty (0,) if only points mark it.
            points: Rows (N, 3) of x, y, [px], and 1 for a point on the part, 0 for one outside; may be empty if there is a box.
        """
        ...

    def at_points(self, points_px: ArrayLike) -> "PointMasks":
        """Compute masks of the regions at points (N, 2), [px]; a point may have none, one or several masks."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PointMasks:
    """Masks of the regions at points, in the order of the points.

    Attributes:
        masks: Masks (M, H, W).
        quality: IoU of each mask that the segmenter predicts (M,), 0..1; 1 for masks from label images.
        stability: IoU (M,) between the masks at a higher and at a lower threshold of the scores, 0..1.
    """

    masks: Annotated[NDArray[np.bool_], "M _ _"]
    quality: Annotated[NDArray[np.float32], "M"]
    stability: Annotated[NDArray[np.float32], "M"]

    __post_init__ = freeze_arrays


def masks_of_logits(
    logits: Sequence[NDArray[np.floating]], quality: ArrayLike, shape: tuple[int, ...]
) -> PointMasks:
    """Convert score images to masks of the image's size.

    Args:
        logits: Score images (h, w) of any size, each of which covers the whole image; the threshold is 0.
        quality: Predicted IoU of each mask (M,), 0..1.
        shape: Height and width of the image.
    """
    if not len(logits):
        return wrap_masks([], shape)
    size = (shape[1], shape[0])
    large = [
        Image.fromarray(np.asarray(item, np.float32)).resize(size, Image.Resampling.BILINEAR)
        for item in logits
    ]
    scores = np.stack([np.asarray(item) for item in large])
    tight, loose = (scores > 1).sum((1, 2)), (scores > -1).sum((1, 2))
    return PointMasks(
        masks=scores > 0,
        quality=np.asarray(quality, np.float32),
        stability=(tight / np.maximum(loose, 1)).astype(np.float32),
    )


def wrap_masks(masks: Sequence[Mask], shape: tuple[int, ...]) -> PointMasks:
    """Build point masks of quality and stability 1; `shape` is the height and width of the image."""
    certain = np.ones(len(masks), np.float32)
    stack = np.stack(masks) if len(masks) else np.zeros((0, *shape), bool)
    return PointMasks(masks=stack, quality=certain, stability=certain)


def clean(mask: Mask) -> Mask:
    """Smooth a mask (H, W) by closing and opening, keep its largest connected component, and fill the holes.

    The mask is returned unchanged if nothing remains after the opening.
    """
    smooth = binary_opening(binary_closing(mask, iterations=2), iterations=1)
    pieces = np.zeros(mask.shape, np.int32)
    if label(smooth, output=pieces) == 0:
        return mask
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    return np.asarray(binary_fill_holes(pieces == int(np.argmax(sizes))), bool)
