"""Which grasps the demonstrations of an object use: as few as serve most draws, so that policies can learn from them.

Many grasps work for a draw, and each works for some draws only. The one nearest to the demonstrated differs from draw to
draw: of a microwave's 150 demonstrations 46 would share the most usual grasp among 26, and a policy learns their mean.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

# So many draws tell which grasps work.
DRAWS: Final = 24
# Folder of the choices, one file for each object, below that of all episodes.
GRASPS_FOLDER: Final = "grasps"


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspChoice:
    """Of one object.

    Attributes:
        names: Grasps, the first to be tried first.
        served: For how many of the draws each works for which those before it do not.
        draws: How many were looked at.
    """

    names: tuple[str, ...]
    served: tuple[int, ...]
    draws: int


def choose_grasps(working: Sequence[Sequence[str]]) -> GraspChoice:
    """The grasp that works for most draws, then that which works for most of the rest, and so on.

    Args:
        working: For every draw the names of the grasps that work, the best first; of grasps that serve as many draws
            the one is chosen that comes first.
    """
    left, found = list(working), list[tuple[str, int]]()
    while counts := Counter(name for names in left for name in names):
        chosen = max(counts, key=counts.__getitem__)
        found.append((chosen, counts[chosen]))
        left = [names for names in left if chosen not in names]
    return GraspChoice(
        names=tuple(name for name, _ in found), served=tuple(count for _, count in found), draws=len(working)
    )
