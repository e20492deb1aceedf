"""The usual grasp, which all demonstrations of a category approximate so that policies can learn from them.

Many grasps work for a draw, and each works for some draws only. The grasp nearest to the demonstrated one
differs from draw to draw: 150 demonstrations of a microwave would use 26 grasps, the most frequent one 46
times, and a policy would learn their mean. All objects of a category share the grasp: how another microwave
is held is not visible, so a policy that learned from several objects would learn the mean of their grasps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Final

import numpy as np

from aomgen.episodes.grasps import Grasp, difference

# Number of draws that determine which grasps work; with many objects fewer suffice for each,
# but at least this many.
DRAWS, LEAST_DRAWS = 24, 4
# Folder of the working grasps, one file per object, and of the choices, one per category, in the
# folder of all episodes.
GRASPS_FOLDER: Final = "grasps"


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkingGrasps:
    """Working grasps of one object.

    Attributes:
        draws: For each of its first draws the grasps with which an episode could be planned.
    """

    draws: tuple[tuple[Grasp, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspChoice:
    """Usual grasp of a category's objects.

    Attributes:
        usual: The grasp; None if no grasp works.
        mean_rad: Mean difference of the draws' grasps from it, see `grasps.difference`.
        draws: Number of draws that were examined.
    """

    usual: Grasp | None
    mean_rad: float
    draws: int


def draws_of(objects: int) -> int:
    """Return how many draws of each object are examined for a number of objects."""
    return max(LEAST_DRAWS, DRAWS // objects)


def choose_grasp(working: Sequence[Sequence[Grasp]]) -> GraspChoice:
    """Choose the grasp with the smallest mean difference to the most similar grasp of each draw.

    Args:
        working: Working grasps of every draw; among equal candidates the first one is chosen.
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
