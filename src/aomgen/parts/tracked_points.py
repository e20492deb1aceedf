"""Points known to move or to stand still: from the grasp and from tracks in the video."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING
from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze_arrays
from aomgen.parts.panel import Panel

# Log odds from which a point counts: e = 2.7 to 1.
MIN_LOG_ODDS = 1.0
# Points farther from the panel than this, as share of its diagonal, are of other things.
REACH_SHARE = 1.2
# A few large Gaussians do not speak for all: areas are cut at this quantile.
LARGEST_QUANTILE = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedPoints:
    """Points and how surely they move.

    Attributes:
        points: (N, 3), world frame; panel frame once `near` a panel, [m].
        moves: (N,).
        weights: (N,), area times certainty.
    """

    points: Annotated[Array, "N 3"]
    moves: Annotated[NDArray[np.bool_], "N"]
    weights: Annotated[Array, "N"]

    __post_init__ = freeze_arrays

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
        """Those around a panel of a diagonal `size` [m], panel frame."""
        local = apply(invert(T_world_panel), self.points)
        kept = (np.abs(local) < REACH_SHARE * size).all(1)
        return TrackedPoints(points=local[kept], moves=self.moves[kept], weights=self.weights[kept])

    def loss(self, panel: Panel) -> float:
        """Distance, 1 - IoU, of what moves by the panel from what was seen to move; 0 where nothing was."""
        found = panel.labels_local(self.points) == MOVING
        either = float(self.weights @ (found | self.moves))
        return 1.0 - float(self.weights @ (found & self.moves)) / either if either > 0 else 0.0
