"""Part labels of Gaussians, and points of a labeled part."""

from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.gaussians import Gaussians, concatenate
from aomgen.core.transforms import matrix_from_quat
from aomgen.core.values import Array, freeze_arrays

# Gaussians with a lower opacity do not represent a surface.
SOLID_OPACITY: Final = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class Cut:
    """Gaussians that were split at part borders, and their pieces.

    Attributes:
        sources: Index of the original Gaussian of each piece (M,).
        pieces: The M pieces.
    """

    sources: Annotated[NDArray[np.int64], "N"]
    pieces: Annotated[Gaussians, "N"]

    __post_init__ = freeze_arrays

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """Return all Gaussians that were not split, in order, followed by the pieces."""
        return concatenate([gaussians.select(self._whole(len(gaussians))), self.pieces])

    def origins(self, count: int) -> NDArray[np.int64]:
        """Return the index, among `count` original Gaussians, of the source of each Gaussian that `apply` returns."""
        return np.concatenate([np.flatnonzero(self._whole(count)), self.sources])

    def _whole(self, count: int) -> NDArray[np.bool_]:
        whole = np.ones(count, bool)
        whole[self.sources] = False
        return whole


def no_cut(gaussians: Gaussians) -> Cut:
    """Return the cut without pieces."""
    return Cut(sources=np.zeros(0, np.int64), pieces=gaussians.select(np.zeros(0, np.int64)))


# A larger misfit of the boxes (5 % of the box per side) causes a warning.
DOUBTED_MISFIT = 0.2
# A lower overlap (IoU) of the labels with the prompts' masks causes a warning: on eleven captures, such labels had an IoU of
# 0.40 to 0.83 with the true part, and the IoU of all other labels was higher.
DOUBTED_AGREEMENT = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Parts:
    """Part labels of N Gaussians, which are those of the scan after some were split.

    Attributes:
        labels: Labels (N,), see `conventions.PART_LABELS`.
        robot_bodies: Index into the robot's `body_names` (N,); -1 for other labels than robot.
        cut: Gaussians of the scan that were split, and their pieces.
        method: "boxes" (two boxes explain the evidence), "masks" (no part resembles a panel), or the name of another
            method.
        box_misfit: Distance of the labels' extents from the prompts' boxes, see `box_misfit`.
        static_agreement, moving_agreement: IoU of the rendered part with its masks in the prompted images, 0..1.
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
        """List warnings about parts that may be wrong."""
        sentences = []
        if not self.box_misfit <= DOUBTED_MISFIT:
            sentences.append(
                f"the edges of the fitted parts are {100 * self.box_misfit / 4:.0f} % of a box away from the "
                f"prompted boxes, limit {100 * DOUBTED_MISFIT / 4:.0f} %; draw boxes that touch each part on "
                "all four sides"
            )
        for name, iou in (("static", self.static_agreement), ("moving", self.moving_agreement)):
            if not iou >= DOUBTED_AGREEMENT:
                sentences.append(
                    f"labels of the {name} part are doubtful: they overlap with its masks by {100 * iou:.0f} %, "
                    f"at least {100 * DOUBTED_AGREEMENT:.0f} % are expected; inspect the labels, and add prompts of "
                    f"'{name}' on images from other sides"
                )
        return sentences


def surface_points(gaussians: Gaussians, labels: NDArray[np.uint8], label: int) -> Array:
    """Select the centers (N, 3) of a part's solid Gaussians, in their frame, [m].

    Args:
        gaussians: G Gaussians of the scene.
        labels: Part label of every Gaussian (G,), see `conventions`.
        label: Label of the part.
    """
    return np.asarray(gaussians.means[(labels == label) & (gaussians.opacities > SOLID_OPACITY)], np.float64)


def spread_points(gaussians: Gaussians, labels: NDArray[np.uint8], label: int, spacing_m: float) -> Array:
    """Sample points (N, 3) along the longest axis of each solid Gaussian of a part, in their frame, [m].

    A thin bar consists of few long Gaussians, so that their centers alone would leave gaps.

    Args:
        gaussians: G Gaussians of the scene.
        labels: Part label of every Gaussian (G,), see `conventions`.
        label: Label of the part.
        spacing_m: Distance of neighboring points, [m]; the points extend to one standard deviation from the center.
    """
    part = gaussians.select((labels == label) & (gaussians.opacities > SOLID_OPACITY))
    longest = np.argmax(part.scales, axis=1)
    rows = np.arange(len(part))
    reach = part.scales[rows, longest].astype(np.float64)
    axes = matrix_from_quat(part.quats.astype(np.float64))[rows, :, longest]
    steps = np.floor(reach / spacing_m).astype(int)
    counts = 2 * steps + 1
    owners = np.repeat(rows, counts)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) - steps[owners]
    return part.means.astype(np.float64)[owners] + (number * spacing_m)[:, None] * axes[owners]
