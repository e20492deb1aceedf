"""The similarity between reconstruction and world, and how well it is known."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from aomgen.core.fixed_camera import FixedCamera
from aomgen.core.values import Array, Matrix4, freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """The similarity and its confidence.

    Attributes:
        S_world_recon: Similarity (4, 4), metres per recon unit included.
        support: Share of outline points, over all views, that the images confirm within 2 px.
        chance: The same for the outlines moved aside.
        runner_up_support: The same for the best different hypothesis, 0 when there was none.
        residual_px: Median distance of confirmed outline points from image edges.
        residual_px_of_view: The same for each view that shows enough robot.
        ee_sd_m: Standard deviation of the end effector.
        joint_zeros_rad: What to add to each joint of the log (J,), see `calibrate_fixed_cameras`; 0 where
            nothing speaks for it, empty before that was looked at.
        joint_zero_sds_rad: Standard deviations.
        cameras: Fixed cameras by name; empty before they were calibrated.
    """

    S_world_recon: Matrix4
    support: float
    chance: float
    runner_up_support: float
    residual_px: float
    residual_px_of_view: dict[str, float]
    ee_sd_m: float
    joint_zeros_rad: Annotated[Array, "J"] = field(default_factory=lambda: np.zeros(0))
    joint_zero_sds_rad: Annotated[Array, "J"] = field(default_factory=lambda: np.zeros(0))
    cameras: dict[str, FixedCamera] = field(default_factory=dict)

    __post_init__ = freeze_arrays
