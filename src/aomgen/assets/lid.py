"""The hinge of lids that open upwards and backwards: toolboxes and laptops."""

from typing import Final

import numpy as np

from aomgen.core.joint import Joint

# Free height between body and closed lid, [m].
SEAL: Final = 0.002


def back_hinge(depth: float, seam: float, opening: float) -> Joint:
    """Joint of a lid on a body of some depth, asset frame.

    Args:
        depth: Of the body, front to back, [m].
        seam: Height at which the body ends, [m].
        opening: Largest turn, [rad].
    """
    # Behind the back by half a seal, so that the lid's back swings clear of the body's.
    origin = np.array([0.0, depth / 2 + SEAL / 2, seam + SEAL / 2])
    return Joint(type="revolute", axis=np.array([-1.0, 0.0, 0.0]), origin=origin, lower=0.0, upper=opening)
