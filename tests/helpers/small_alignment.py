"""An alignment of which tests replace what they need."""

import numpy as np

from aomgen.core.alignment import Alignment

ALIGNMENT = Alignment(
    S_world_recon=np.eye(4),
    support=1.0,
    chance=0.0,
    runner_up_support=0.0,
    residual_px=0.3,
    residual_px_of_view={},
    ee_sd_m=0.001,
)
