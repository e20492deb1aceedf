"""The usual grasp of an object: all demonstrations hold it as nearly so as they can, so that policies can learn from them.

Many grasps work for a draw, and each works for some draws only. The one nearest to the demonstrated differs from draw to
draw: of a microwave's 150 demonstrations 46 would share the most frequent grasp among 26, and a policy learns their mean.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from aomgen.episodes.grasps import Grasp, difference

# So many draws tell which grasps work.
DRAWS: Final = 24
# Folder of the choices, one file for each object, below that of all episodes.
GRASPS_FOLDER: Final = "grasps"


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspChoice:
    """Of one object.

    Attributes:
        usual: Name of the grasp; empty where none works.
        mean_rad: How much the grasp of a draw differs from it in the mean, see `grasps.difference`.
        draws: How many were looked at.
    """

    usual: str
    mean_rad: float
    draws: int


def choose_grasp(working: Sequence[Sequence[Grasp]]) -> GraspChoice:
    """The grasp from which the draws' grasps differ least in the mean, when each draw takes the one that is most like it.

    Args:
        working: For every draw the grasps that work; of equals the one is chosen that comes first.
    """
    served = [grasps for grasps in working if grasps]
    candidates = {grasp.name: grasp for grasps in served for grasp in grasps}
    means = {
        name: sum(min(difference(usual, grasp) for grasp in grasps) for grasps in served) / len(served)
        for name, usual in candidates.items()
    }
    usual = min(means, key=lambda name: round(means[name], 6), default="")
    return GraspChoice(usual=usual, mean_rad=means.get(usual, 0.0), draws=len(working))
