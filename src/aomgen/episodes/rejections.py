"""Location and order of the rejections of a plan's candidates."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.plan import Rejection
from aomgen.episodes.retarget import CONTACT

# Reasons of rejection, from early to late.
REASONS: Final = (
    "joint_limit",
    "unreachable",
    "too_fast",
    "too_jerky",
    "self_collision",
    "collision",
    "no_path",
    "grip_collision",
    "no_grip",
)


def locate(rejection: Rejection, phases: NDArray[np.int64], first: int = 0) -> Rejection:
    """Add the location to a rejection of rows from `first` on; in contact no other approach helps."""
    row = first + round(rejection.metrics["sample"])
    where = {"path_share": row / len(phases), "in_contact": float(phases[row] == CONTACT)}
    return replace(rejection, metrics={**rejection.metrics, **where})


def rank(rejection: Rejection) -> float:
    """Rank how far planning came, to find the most informative of several rejections."""
    known = REASONS.index(rejection.reason) if rejection.reason in REASONS else -1
    return known + rejection.metrics.get("path_share", 0.0)
