"""The usual grasp: all demonstrations hold their objects as nearly so as they can, so that policies can learn from them.

Many grasps work for a draw, and each works for some draws only. The one nearest to the demonstrated differs from draw to
draw: of a microwave's 150 demonstrations 46 would share the most frequent grasp among 26, and a policy learns their mean.
Objects of one category share it: how another microwave is held cannot be seen, and a policy that learned from several
would learn the mean of theirs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Final

import numpy as np

from aomgen.episodes.grasps import Grasp, difference

# So many draws tell which grasps work; of each of many objects fewer do, but so many at least.
DRAWS, LEAST_DRAWS = 24, 4
# Folder of the working grasps, one file for each object, and of the choices, one for each category, below that of all
# episodes.
GRASPS_FOLDER: Final = "grasps"


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkingGrasps:
    """Of one object.

    Attributes:
        draws: For each of its first draws the grasps with which an episode could be planned.
    """

    draws: tuple[tuple[Grasp, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspChoice:
    """Of a category's objects.

    Attributes:
        usual: None where none works.
        mean_rad: How much the grasp of a draw differs from it in the mean, see `grasps.difference`.
        draws: How many were looked at.
    """

    usual: Grasp | None
    mean_rad: float
    draws: int


def draws_of(objects: int) -> int:
    """How many draws of each of so many objects are looked at."""
    return max(LEAST_DRAWS, DRAWS // objects)


def choose_grasp(working: Sequence[Sequence[Grasp]]) -> GraspChoice:
    """The grasp from which the draws' grasps differ least in the mean, when each draw takes the one that is most like it.

    Args:
        working: For every draw the grasps that work; of equals the one is chosen that comes first.
    """
    served = [grasps for grasps in working if grasps]
    candidates: dict[tuple[float, ...], Grasp] = {}
    for grasp in chain.from_iterable(served):
        candidates.setdefault((*grasp.R_object_ee.ravel().round(3), round(grasp.turn_ratio, 3)), grasp)
    means = [
        sum(min(difference(usual, grasp) for grasp in grasps) for grasps in served) / len(served)
        for usual in candidates.values()
    ]
    if not means:
        return GraspChoice(usual=None, mean_rad=0.0, draws=len(working))
    best = int(np.argmin(np.round(means, 6)))
    return GraspChoice(usual=list(candidates.values())[best], mean_rad=means[best], draws=len(working))
