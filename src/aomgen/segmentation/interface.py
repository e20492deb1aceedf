"""Interface of all segmenters: masks of a prepared image, by box or by points."""

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
    """Return the box x0, y0, x1, y1 around a mask (H, W), [px], which has at least one pixel."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float64)


class Segmenter(Protocol):
    """Whatever turns boxes and points on an image into a mask."""

    def prepare(self, name: str, image_srgb: NDArray[np.uint8]) -> "PreparedImage":
        """Do the work that all prompts on one image share."""
        ...


class PreparedImage(Protocol):
    """An image that is ready for prompts."""

    def mask(self, part: str, box_px: ArrayLike, points: ArrayLike) -> Mask:
        """Mask (H, W) of a part.

        Args:
            part: "moving", "static" or "object" (both); only label images need it.
            box_px: x0, y0, x1, y1 (4,), [px], around the part; or (0,), where points alone mark it.
            points: (N, 3): x, y [px] and 1 = on the part, 0 = not on it; may be empty beside a box.
        """
        ...

    def at_points(self, points_px: ArrayLike) -> "PointMasks":
        """Masks of whatever lies under each of the points (N, 2), [px]; none, one or several a point."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PointMasks:
    """Masks of points without a part's name, in the order of the points.

    Attributes:
        masks: (M, H, W).
        quality: (M,), IoU that the segmenter expects of its mask, 0..1; 1 where masks are given.
        stability: (M,), IoU between the mask cut a little tighter and a little looser, 0..1.
    """

    masks: Annotated[NDArray[np.bool_], "M _ _"]
    quality: Annotated[NDArray[np.float32], "M"]
    stability: Annotated[NDArray[np.float32], "M"]

    __post_init__ = freeze_arrays


def masks_of_logits(
    logits: Sequence[NDArray[np.floating]], quality: ArrayLike, shape: tuple[int, ...]
) -> PointMasks:
    """Point masks of full size from small score images that cover the whole image."""
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
    """Point masks that are certain of themselves."""
    certain = np.ones(len(masks), np.float32)
    stack = np.stack(masks) if len(masks) else np.zeros((0, *shape), bool)
    return PointMasks(masks=stack, quality=certain, stability=certain)


def clean(mask: Mask) -> Mask:
    """Closed, opened, its largest piece, holes filled."""
    smooth = binary_opening(binary_closing(mask, iterations=2), iterations=1)
    pieces = np.zeros(mask.shape, np.int32)
    if label(smooth, output=pieces) == 0:
        return mask
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    return np.asarray(binary_fill_holes(pieces == int(np.argmax(sizes))), bool)
