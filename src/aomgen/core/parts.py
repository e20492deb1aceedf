"""Which part of the scene each Gaussian belongs to."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.core.gaussians import Gaussians, concatenate
from aomgen.core.values import freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Cut:
    """Gaussians cut, and their pieces.

    Attributes:
        sources: (M,) index of the Gaussian that each piece comes from.
        pieces: M of them.
    """

    sources: Annotated[NDArray[np.int64], "N"]
    pieces: Annotated[Gaussians, "N"]

    __post_init__ = freeze_arrays

    def applied(self, gaussians: Gaussians) -> Gaussians:
        """All that is whole, in order, then the pieces."""
        return concatenate([gaussians.select(self._whole(len(gaussians))), self.pieces])

    def origins(self, count: int) -> NDArray[np.int64]:
        """For each Gaussian of `applied`, which of the `count` it is or comes from."""
        return np.concatenate([np.flatnonzero(self._whole(count)), self.sources])

    def _whole(self, count: int) -> NDArray[np.bool_]:
        whole = np.ones(count, bool)
        whole[self.sources] = False
        return whole


def no_cut(gaussians: Gaussians) -> Cut:
    """Nothing is cut."""
    return Cut(sources=np.zeros(0, np.int64), pieces=gaussians.select(np.zeros(0, np.int64)))


# Boxes explained worse than this (5 % of the box a side) are worth a warning.
DOUBTED_MISFIT = 0.2


# Labels that overlap with the prompts' masks less than this (IoU) are worth a warning: on eleven captures
# they overlapped with the true part by .40 to .83, all others by more.
DOUBTED_AGREEMENT = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Parts:
    """Labels of N Gaussians: those of the scan, some of them cut.

    Attributes:
        labels: (N,), see `conventions.PART_LABELS`.
        robot_bodies: (N,), index into the robot's `body_names`, -1 where the label is not robot.
        cut: Which Gaussians of the scan were cut, and their pieces.
        method: "boxes" (two boxes explain the evidence), "masks" (nothing is like a panel) or another one's name.
        box_misfit: How far the labels' extents are from the prompts' boxes, see `box_misfit`.
        static_agreement, moving_agreement: IoU of the drawn part with its masks in the prompted images, 0..1.
    """

    labels: Annotated[NDArray[np.uint8], "N"]
    robot_bodies: Annotated[NDArray[np.int32], "N"]
    cut: Cut
    method: str
    box_misfit: float
    static_agreement: float
    moving_agreement: float

    __post_init__ = freeze_arrays

    def warnings(self) -> list[str]:
        """Sentences about parts that may be wrong."""
        sentences = []
        if not self.box_misfit <= DOUBTED_MISFIT:
            sentences.append(
                f"the parts found end {100 * self.box_misfit / 4:.0f} % of a box away from the prompts' boxes, "
                f"want {100 * DOUBTED_MISFIT / 4:.0f} %; draw boxes that touch each part on all four sides"
            )
        for name, iou in (("static", self.static_agreement), ("moving", self.moving_agreement)):
            if not iou >= DOUBTED_AGREEMENT:
                sentences.append(
                    f"labels of the {name} part are doubtful: they overlap with its masks by {100 * iou:.0f} %, "
                    f"want {100 * DOUBTED_AGREEMENT:.0f} %; look at the labels, and add prompts of '{name}' on "
                    "images that show it from other sides"
                )
        return sentences
