"""True masks of a video with the errors that a segmenter makes, for methods that need masks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, zoom

from aomgen.conventions import MOVING, ROBOT
from aomgen.core.values import Array
from aomgen.paper.mask_keyframes import PartMasks

WIDTH = 320


@dataclass(frozen=True, slots=True, kw_only=True)
class MaskErrors:
    """Errors of a mask's outline, [px] in images 320 px wide, standard deviations.

    Measured on MobileSAM's masks of a door and a drawer in three videos, prompted with the box around the
    true mask: a mean error of 0.6 to 4 px, of which 0.02 to 0.2 px change from one frame to the next in
    a still scene and 0.4 to 1.4 px while arm or part move. The values are at the lower end, as SAM 2
    tracks a part more steadily.

    Attributes:
        lasting: Error that is equal in all frames.
        flicker: Error that is independent in every frame.
        spacing: Distance along the outline at which errors are independent.
    """

    lasting: float = 1.0
    flicker: float = 0.15
    spacing: float = 8.0


def segmented(
    labels: NDArray[np.uint8], rng: np.random.Generator, errors: MaskErrors | None = None
) -> PartMasks:
    """Make masks of moving part and robot as a segmenter gives them, 320 px wide.

    The part's outline is moved back and forth; the robot's, rendered from its log, is unchanged.

    Args:
        labels: True labels (T, H, W), see `conventions.PART_LABELS`.
        rng: Generator of the errors.
        errors: Size of the errors.
    """
    errors = errors or MaskErrors()
    height = round(WIDTH * labels.shape[1] / labels.shape[2])
    rows = ((np.arange(height) + 0.5) * labels.shape[1] / height).astype(int)
    columns = ((np.arange(WIDTH) + 0.5) * labels.shape[2] / WIDTH).astype(int)
    small = labels[:, rows[:, None], columns]
    lasting = errors.lasting * _waves((height, WIDTH), errors.spacing, rng)
    moving = np.empty(small.shape, bool)
    for k, frame in enumerate(small):
        off = lasting + errors.flicker * _waves((height, WIDTH), errors.spacing, rng)
        moving[k] = _moved_outline(frame == MOVING, off) & (frame != ROBOT)
    return PartMasks(moving=moving, robot=small == ROBOT)


def _moved_outline(mask: NDArray[np.bool_], off: Array) -> NDArray[np.bool_]:
    """Move the outline of a mask outwards by `off` (H, W) pixels."""
    if not mask.any() or mask.all():
        return mask
    inside, outside = (np.asarray(distance_transform_edt(side)) for side in (mask, ~mask))
    # Pixel centers are half a pixel from an outline that runs between them.
    return np.asarray(np.where(mask, inside - 0.5, 0.5 - outside) + off > 0)


def _waves(shape: tuple[int, int], spacing: float, rng: np.random.Generator) -> Array:
    """Draw a smooth random field (H, W) of about unit variance."""
    coarse = rng.normal(size=[int(side / spacing) + 2 for side in shape])
    fine = np.asarray(zoom(coarse, spacing, order=1))[: shape[0], : shape[1]]
    return fine / float(fine.std())
