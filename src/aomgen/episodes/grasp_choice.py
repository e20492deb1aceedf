"""Choice of the usual grasp, which all demonstrations of a category approximate so that policies can learn from them.

For a sample many grasps are feasible, and each grasp is feasible for some samples only. The feasible grasp nearest to
the demonstrated one differs between samples: 150 demonstrations of a microwave would use 26 grasps, the most frequent
one 46 times, and a policy would learn their mean. All objects of a category share the usual grasp, because the grasp of
an object is not visible in its image: a policy that is trained with several objects would learn the mean of their
grasps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array
from aomgen.episodes.grasps import Grasp, difference

# Number of samples that determine the usual grasp, and the least number for each of several objects.
DRAWS, LEAST_DRAWS = 24, 4
# Folder of the choices, one file per category, in the folder of all episodes.
GRASPS_FOLDER: Final = "grasps"

# A grasp for one sample, and the test whether an episode can be planned with it.
GraspTest = tuple[Grasp, Callable[[], bool]]


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspChoice:
    """Usual grasp of the objects of a category.

    Attributes:
        usual: The grasp; None if no grasp is feasible.
        mean_rad: Mean difference between it and the most similar feasible grasps, see `grasps.difference`.
        draws: Number of samples that were examined.
    """

    usual: Grasp | None
    mean_rad: float
    draws: int


def draws_of(objects: int) -> int:
    """Return the number of samples that are examined for each of several objects."""
    return max(LEAST_DRAWS, DRAWS // objects)


def choose_grasp(draws: Sequence[Sequence[GraspTest]]) -> GraspChoice:
    """Choose the grasp with the smallest mean difference to the most similar feasible grasp of each sample.

    The search is best-first: it selects the candidate that would be the best if all untested grasps were feasible, and
    tests the grasps that determine its mean, until the mean of the best candidate is known. Most grasps are not tested.

    Args:
        draws: Grasps of every sample in order of preference; among equal candidates the first one is chosen. Samples
            without a feasible grasp are ignored.
    """
    candidates: dict[tuple[float, ...], Grasp] = {}
    for grasp, _ in chain.from_iterable(draws):
        candidates.setdefault(_key(grasp), grasp)
    grasps, numbers = list(candidates.values()), {key: number for number, key in enumerate(candidates)}
    tests = [{numbers[_key(grasp)]: test for grasp, test in offered} for offered in draws]
    apart = np.array([[difference(a, b) for b in grasps] for a in grasps])

    def measure(row: NDArray[np.bool_]) -> Array:
        """Compute the difference of all candidates (C,) from the most similar one of a selection."""
        return np.asarray(apart[:, row].min(1) if row.any() else np.zeros(len(row)), np.float64)

    # Grasps (D, C) that have not failed, and grasps that have been tested and are feasible.
    possible = np.array([[number in row for number in range(len(grasps))] for row in tests], bool)
    works, useful = np.zeros_like(possible), np.ones(len(grasps), bool)
    nearest = np.array([measure(row) for row in possible])
    while useful.any():
        best = int(np.argmin(np.where(useful, nearest.sum(0).round(6), np.inf)))
        similar = possible & (apart[best] <= nearest[:, best, None])
        unknown = similar.any(1) & ~(similar & works).any(1)
        if unknown.any():
            draw = int(np.argmax(unknown))
            number = int(np.argmax(similar[draw]))
            works[draw, number] = possible[draw, number] = tests[draw][number]()
            nearest[draw] = measure(possible[draw])
        elif works[:, best].any():
            mean = float(nearest[works.any(1), best].mean())
            return GraspChoice(usual=grasps[best], mean_rad=mean, draws=len(draws))
        else:
            useful[best] = False
    return GraspChoice(usual=None, mean_rad=0.0, draws=len(draws))


def _key(grasp: Grasp) -> tuple[float, ...]:
    """Return a key that is equal for equal grasps of different samples."""
    return (*grasp.R_object_ee.ravel().round(3), round(grasp.turn_ratio, 3))
